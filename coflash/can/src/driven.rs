//! An adapter with its driver on a thread of its own.
//!
//! A vendor's library may block, return wrong results or never return, and a USB device may stop
//! answering. None of this may block the tool: the thread waits for the driver, and the rest of the
//! tool waits for the thread with a time limit.

use std::fmt;
use std::io;
use std::sync::mpsc::{self, Receiver, RecvTimeoutError, SyncSender, TryRecvError, TrySendError};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::{ExtendedId, Frame as _, Id, StandardId};
use shared_abi::bxcan::data_length;

use super::adapter::{Adapter, AdapterError};
use super::health::{Health, Losses};

/// The frame that a driver reports, with the data length code of the bus: any node may send 9 to 15.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn frame_of(
    id: i64,
    extended: bool,
    remote: bool,
    dlc: u32,
    data: &[u8],
) -> Result<Frame, String> {
    let code = u8::try_from(dlc).ok().filter(|code| *code <= 15);
    let data = code.and_then(|code| data.get(..data_length(code)));
    let data = data.ok_or_else(|| format!("a frame of {dlc} bytes"))?;
    let identifier: Option<Id> = if extended {
        u32::try_from(id).ok().and_then(ExtendedId::new).map(Id::from)
    } else {
        u16::try_from(id).ok().and_then(StandardId::new).map(Id::from)
    };
    let frame = identifier.and_then(|identifier| match remote {
        false => Frame::new(identifier, data),
        true => Frame::new_remote(identifier, data.len()),
    });
    frame.ok_or_else(|| format!("a frame with identifier {id:X}h"))
}

/// The interface between the thread and the hardware.
pub(super) trait Driver {
    /// Puts a frame into the hardware's queue. Does not wait.
    fn send(&mut self, frame: &Frame) -> Result<Sent, Fault>;

    /// Returns the next frame. Waits for at most `wait`. `None` if nothing arrived, or something
    /// that is not a frame.
    fn receive(&mut self, wait: Duration) -> Result<Option<Frame>, Fault>;

    /// What the driver knows about the bus at this time.
    fn health(&mut self) -> Health;

    /// Leaves the bus.
    fn close(&mut self);
}

/// The result of sending a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sent {
    /// The hardware has accepted the frame.
    Taken,
    /// The hardware has no room for the frame at present.
    Full,
}

/// The reasons why an adapter ends.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// The adapter is gone, and the error that showed it.
    Lost(String),
    /// The adapter sends invalid data.
    Nonsense(String),
    /// The adapter accepts no more frames.
    Stuck(Health),
}

/// How long a driver may take to open.
const OPENING: Duration = Duration::from_secs(5);
/// How long a frame may wait for room, and how long a driver may take to close.
const PATIENCE: Duration = Duration::from_secs(1);
/// After so few attempts the time may have passed while the computer slept.
const FEW: u32 = 10;
/// How long the thread waits for a received frame before it checks for a frame to send.
const TURN: Duration = Duration::from_millis(1);
/// How often the driver is asked for the state of the bus.
const STATUS_PERIOD: Duration = Duration::from_millis(50);
/// The most frames that may wait to be sent or to be received. Further frames are lost, as in a
/// controller that is not read.
const OUTGOING: usize = 64;
const INCOMING: usize = 4096;

/// What the thread of the driver reports.
#[derive(Default)]
struct DriverStatus {
    health: Health,
    fault: Option<Fault>,
}

/// The tool's side of the thread.
pub(super) struct Driven {
    name: String,
    opened: Instant,
    /// `None` during drop.
    outgoing: Option<SyncSender<Frame>>,
    incoming: Receiver<Frame>,
    status: Arc<Mutex<DriverStatus>>,
}

impl fmt::Debug for Driven {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Driven").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Driven {
    /// Opens a driver on its own thread. `name` is for messages.
    pub(super) fn open<D: Driver>(
        name: String,
        open: impl FnOnce() -> Result<D, AdapterError> + Send + 'static,
    ) -> Result<Self, AdapterError> {
        let (outgoing, commands) = mpsc::sync_channel(OUTGOING);
        let (frames, incoming) = mpsc::sync_channel(INCOMING);
        let status = Arc::<Mutex<DriverStatus>>::default();
        let shared = status.clone();
        let (ready, opened) = mpsc::sync_channel(1);
        thread::spawn(move || {
            let mut driver = match open() {
                Ok(driver) => driver,
                Err(error) => {
                    let _ = ready.send(Err(error));
                    return;
                }
            };
            // If this fails, the tool has given up waiting for the driver.
            if ready.send(Ok(())).is_ok() {
                if let Err(fault) = work(&mut driver, &commands, &frames, &shared) {
                    lock(&shared).fault = Some(fault);
                }
            }
            driver.close();
        });
        match opened.recv_timeout(OPENING) {
            Ok(Ok(())) => {
                Ok(Self { name, opened: Instant::now(), outgoing: Some(outgoing), incoming, status })
            }
            Ok(Err(error)) => Err(error),
            Err(_) => Err(AdapterError::Open {
                adapter: name,
                source: io::Error::new(
                    io::ErrorKind::TimedOut,
                    format!("its driver has not come back for {} s", OPENING.as_secs()),
                )
                .into(),
            }),
        }
    }

    /// The reason why the thread has ended.
    fn fault(&self) -> AdapterError {
        let adapter = self.name.clone();
        match lock(&self.status).fault.clone() {
            Some(Fault::Nonsense(said)) => AdapterError::Protocol { adapter, said },
            Some(Fault::Stuck(health)) => AdapterError::Stuck { adapter, health },
            Some(Fault::Lost(how)) => AdapterError::Lost { adapter, source: io::Error::other(how).into() },
            None => AdapterError::Lost { adapter, source: io::Error::other("its driver has crashed").into() },
        }
    }
}

/// Locks `status`. A thread that panics leaves nothing half done here.
fn lock(status: &Mutex<DriverStatus>) -> std::sync::MutexGuard<'_, DriverStatus> {
    status.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Carries frames between the tool and the driver until the tool closes the channel.
fn work(
    driver: &mut impl Driver,
    commands: &Receiver<Frame>,
    frames: &SyncSender<Frame>,
    status: &Mutex<DriverStatus>,
) -> Result<(), Fault> {
    // A frame that found no room, the time of the first attempt, and how many there were.
    let mut waiting: Option<(Frame, Instant, u32)> = None;
    let mut reported = Instant::now();
    loop {
        loop {
            let (frame, since, attempts) = match waiting.take() {
                Some(waiting) => waiting,
                None => match commands.try_recv() {
                    Ok(frame) => (frame, Instant::now(), 1),
                    Err(TryRecvError::Empty) => break,
                    Err(TryRecvError::Disconnected) => return Ok(()),
                },
            };
            if driver.send(&frame)? == Sent::Full {
                if since.elapsed() > PATIENCE && attempts > FEW {
                    return Err(Fault::Stuck(driver.health()));
                }
                waiting = Some((frame, since, attempts + 1));
                break;
            }
        }
        if let Some(frame) = driver.receive(TURN)? {
            if let Err(TrySendError::Disconnected(_)) = frames.try_send(frame) {
                return Ok(());
            }
        }
        if reported.elapsed() >= STATUS_PERIOD {
            reported = Instant::now();
            lock(status).health = driver.health();
        }
    }
}

impl Drop for Driven {
    /// Sends the waiting frames and leaves the bus. Gives up if the driver does not return.
    fn drop(&mut self) {
        self.outgoing = None;
        let until = Instant::now() + PATIENCE;
        // The channel closes when the thread ends.
        while let Ok(_) | Err(RecvTimeoutError::Timeout) = self.incoming.recv_timeout(TURN) {
            if Instant::now() >= until {
                break;
            }
        }
    }
}

impl Adapter for Driven {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let until = Instant::now() + 2 * PATIENCE;
        loop {
            let Some(outgoing) = &self.outgoing else { return Err(self.fault()) };
            match outgoing.try_send(*frame) {
                Ok(()) => return Ok(()),
                Err(TrySendError::Full(_)) if Instant::now() < until => {
                    thread::sleep(Duration::from_micros(200));
                }
                Err(TrySendError::Full(_)) => {
                    let source =
                        io::Error::new(io::ErrorKind::TimedOut, "its driver does not come back").into();
                    return Err(AdapterError::Lost { adapter: self.name.clone(), source });
                }
                Err(TrySendError::Disconnected(_)) => return Err(self.fault()),
            }
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        match self.incoming.recv_timeout(timeout) {
            Ok(frame) => Ok(Some(frame)),
            Err(RecvTimeoutError::Timeout) => Ok(None),
            Err(RecvTimeoutError::Disconnected) => Err(self.fault()),
        }
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }

    fn health(&mut self) -> Option<Health> {
        Some(lock(&self.status).health)
    }

    fn losses(&self) -> Losses {
        lock(&self.status).health.losses
    }
}
