//! The built firmware in the emulator.

use attack::device::{Action, Trouble};
use canopen::Frame;
use emulator::bus::fault::{Fault, FaultAction, FrameMatch, When};
use emulator::bus::Outcome;
use emulator::machine::{Cut, FlashCut, ResetCause, Stop};
use emulator::time::{Span, Time};
use emulator::world::PortId;
use kit::model::Cut as ModelCut;
use shared_abi::layout::Layout;

use super::target::{Event, Happened, Target, OFF_US};
use crate::bench::{convert, Bench, BIT_RATE};

/// A board on a bus with two masters.
pub struct Board {
    /// The bench of the board.
    pub bench: Bench,
    masters: [PortId; 2],
    /// Frames of the masters so far.
    sent: u64,
}

/// One us.
const US: u64 = Span::from_micros(1).0;

impl Board {
    /// A board with this bootloader and these bytes in its key block, switched on.
    ///
    /// # Panics
    /// Never: the key block is in flash.
    #[must_use]
    pub fn new(layout: &Layout, bootloader: &str, keys: &[u8]) -> Self {
        let mut bench = Bench::of_image(bootloader);
        bench.machine().load_bin(layout.key_block().base, keys).expect("it is in flash");
        let masters = [0; 2].map(|_| bench.world.add_host_port(BIT_RATE));
        bench.power_on();
        Self { bench, masters, sent: 0 }
    }
}

/// A data length code that means eight bytes (ISO 11898-1:2015, table 5), each of them in turn.
pub(super) const fn long_dlc(sent: u64) -> u8 {
    8 + (sent % 8) as u8
}

fn micros(at: Time) -> u64 {
    at.0 / US
}

impl Target for Board {
    fn now_us(&self) -> u64 {
        micros(self.bench.time())
    }

    fn send(&mut self, master: usize, frame: &Frame) {
        let Some(frame) = convert::<_, emulator::frame::Frame>(frame) else { return };
        self.sent += 1;
        let long = frame.with_dlc(long_dlc(self.sent)).filter(|_| frame.dlc() == 8);
        self.bench.world.send(self.masters[master], long.unwrap_or(frame));
    }

    fn is_drained(&mut self) -> bool {
        self.masters.into_iter().all(|port| self.bench.world.port_mut(port).waiting() == 0)
    }

    fn pass_us(&mut self, us: u64) {
        self.bench.world.run_for(Span(us * US));
    }

    fn events(&mut self) -> Vec<Event> {
        let device = self.bench.device.node();
        // Nobody reads what the masters receive: the records have all of it.
        for port in self.masters {
            while self.bench.world.receive(port).is_some() {}
            while self.bench.world.port_mut(port).sent().is_some() {}
        }
        self.bench.forget_received();
        let frames = self.bench.take_records().into_iter().map(|record| {
            let happened = match record.outcome {
                Outcome::Good => match convert(&record.frame) {
                    Some(frame) if record.from == Some(device) => Happened::Frame { by_device: true, frame },
                    Some(frame) if record.readers >> device & 1 == 1 => {
                        Happened::Frame { by_device: false, frame }
                    }
                    Some(frame) => Happened::Missed(frame),
                    None => Happened::Error,
                },
                Outcome::KeptBack | Outcome::Bad(_) => Happened::Error,
            };
            (micros(record.end), happened)
        });
        let mut events: Vec<Event> = frames.collect();
        for (at, stop) in self.bench.events() {
            let happened = match stop {
                Stop::Reset(ResetCause::Software) => Happened::Reset,
                Stop::PowerCut => Happened::PowerCut,
                // The power came on.
                Stop::Reset(ResetCause::PowerOn) => continue,
                Stop::Reset(
                    ResetCause::IndependentWatchdog
                    | ResetCause::Pin
                    | ResetCause::WindowWatchdog
                    | ResetCause::LowPower
                    | ResetCause::Standby
                    | ResetCause::BrownOut,
                )
                | Stop::Lockup => Happened::Trouble,
                Stop::Deadline | Stop::Attention | Stop::Halted => continue,
            };
            events.push((micros(at), happened));
        }
        events.sort_by_key(|(at, _)| *at);
        events
    }

    fn flash(&mut self) -> &[u8] {
        self.bench.machine().flash()
    }

    fn flash_activity(&mut self) -> (u64, bool) {
        // FLASH_SR.BSY (RM0090 section 3.9.5).
        const SR: u32 = 0x4002_3C0C;
        let machine = self.bench.machine();
        let busy = machine.register(SR).is_some_and(|status| status >> 16 & 1 == 1);
        let counters = machine.counters();
        (counters.sectors_erased + counters.units_programmed, busy)
    }

    fn act(&mut self, action: &Action) {
        match *action {
            Action::PowerOff => {
                self.bench.power_off();
                self.pass_us(OFF_US);
                self.bench.machine().cut_power_at(None);
                self.bench.power_on();
            }
            Action::Flash(operation, Trouble::Cut(cut)) => {
                let when = match cut {
                    ModelCut::Before => Cut::Before,
                    ModelCut::After => Cut::After,
                    ModelCut::Torn(seed) => Cut::Torn { seed },
                    ModelCut::Unstable(seed) => Cut::Unstable { seed },
                };
                let cut = FlashCut { operation: operation.into(), when };
                self.bench.machine().cut_power_at(Some(cut));
            }
            Action::Disturb(frames) => {
                self.bench.world.clear_faults();
                let mine = FrameMatch { from: Some(self.bench.device.node()), ..FrameMatch::default() };
                for n in 1..=frames {
                    let fault =
                        Fault { frames: mine.clone(), when: When::Nth(n), action: FaultAction::Disturb };
                    self.bench.world.inject(fault);
                }
            }
            _ => {}
        }
    }

    fn set_bit_rate(&mut self, bit_rate: u32) {
        self.bench.set_host_bit_rate(bit_rate);
        for port in self.masters {
            self.bench.world.port_mut(port).set_bit_rate(bit_rate);
        }
    }

    fn longest_between_feeds_us(&mut self) -> u64 {
        self.bench.machine().counters().longest_between_feeds.0 / US
    }

    fn complaint(&mut self) -> Option<String> {
        let device = self.bench.device;
        let reports = self.bench.world.machine_mut(device).reports();
        (!reports.is_empty()).then(|| format!("it touched what the emulator does not model: {reports:?}"))
    }
}
