//! Linux SocketCAN: the CAN interfaces of the kernel.

use std::io::ErrorKind;
use std::thread;
use std::time::{Duration, Instant};

use canopen::Frame;
use embedded_can::Frame as _;
use socketcan::{CanFrame, CanSocket, Socket};

use super::adapter::{Adapter, AdapterError};

/// How long the interface may take to accept a frame. Its queue is full while nobody acknowledges
/// on the bus.
const PATIENCE: Duration = Duration::from_secs(1);
/// `ENOBUFS`: the interface's queue is full. The kernel does not block for it.
const QUEUE_FULL: i32 = 105;

/// A CAN interface of the kernel.
#[derive(Debug)]
pub struct SocketCan {
    socket: CanSocket,
    name: String,
    opened: Instant,
}

impl SocketCan {
    /// Opens an interface, `can0` for example. Its bit rate is set and it is switched on by `ip
    /// link`.
    ///
    /// # Errors
    /// [`AdapterError::Open`].
    pub fn open(interface: &str) -> Result<Self, AdapterError> {
        let name = format!("CAN interface {interface}");
        let socket = CanSocket::open(interface)
            .map_err(|source| AdapterError::Open { adapter: name.clone(), source })?;
        Ok(Self { socket, name, opened: Instant::now() })
    }

    fn lost(&self, source: std::io::Error) -> AdapterError {
        AdapterError::Lost { adapter: self.name.clone(), source }
    }
}

impl Adapter for SocketCan {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        let made = if frame.is_remote_frame() {
            CanFrame::new_remote(frame.id(), frame.dlc())
        } else {
            CanFrame::new(frame.id(), frame.data())
        };
        // Both kinds of frame have an identifier of 11 or 29 bits and at most 8 bytes.
        let Some(made) = made else { return Ok(()) };
        let deadline = Instant::now() + PATIENCE;
        loop {
            match self.socket.write_frame(&made) {
                Ok(()) => return Ok(()),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.raw_os_error() == Some(QUEUE_FULL) && Instant::now() < deadline => {
                    thread::sleep(Duration::from_millis(1));
                }
                Err(error) => return Err(self.lost(error)),
            }
        }
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.socket.read_frame_timeout(left) {
                // Error frames and frames of CAN FD are not for us.
                Ok(CanFrame::Data(frame)) => {
                    if let Some(frame) = Frame::new(frame.id(), frame.data()) {
                        return Ok(Some(frame));
                    }
                }
                Ok(_) => {}
                Err(error)
                    if matches!(
                        error.kind(),
                        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                    ) => {}
                Err(error) => return Err(self.lost(error)),
            }
            if Instant::now() >= deadline {
                return Ok(None);
            }
        }
    }

    fn now(&self) -> Duration {
        self.opened.elapsed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_interface_that_is_not_there_is_named() {
        let error = SocketCan::open("nocan99").unwrap_err();
        assert!(error.to_string().starts_with("CAN interface nocan99 cannot be opened: "), "{error}");
    }
}
