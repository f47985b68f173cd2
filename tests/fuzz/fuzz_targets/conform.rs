//! The checks of `coflash more conform` against a device that answers as it likes: its answers are
//! changed, lost, late and doubled, and foreign frames come at any time, for ever if it likes.
//!
//! Must hold: the checks end, within a bounded time on the clock of the bus and a bounded number of
//! frames; each gives a verdict, and a verdict that is no pass has words.
#![cfg_attr(fuzzing, no_main)]

use std::collections::VecDeque;
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use canopen::node::{Config, NmtPolicy, Node};
use canopen::{CobId, Frame};
use coboot_can::{Adapter, AdapterError};
use coboot_fuzz::Input;
use coflash_conform::{checks, run, Means, Outcome};
use coflash_core::file::convert::{program_of, Options, Region};
use coflash_core::update::Payload;
use embedded_can::Frame as _;
use kit::bus::{at, node, Device};

/// The most time on the bus for all checks together. A check that transfers a program may take
/// minutes on a device that is as slow as it may be.
const MOST: Duration = Duration::from_secs(4 * 3600);
/// What a frame takes.
const FRAME: Duration = Duration::from_micros(250);

/// A device that does what the bytes say.
struct Hostile<'a> {
    now: Duration,
    all: &'a [u8],
    input: Input<'a>,
    /// The bytes begin again at their end.
    endless: bool,
    slave: Node,
    device: Device,
    answers: VecDeque<Frame>,
}

impl Hostile<'_> {
    fn byte(&mut self) -> Option<u8> {
        if let Some(byte) = self.input.byte() {
            return Some(byte);
        }
        if self.endless {
            self.input = Input::new(self.all);
        }
        self.input.byte()
    }

    fn millis(&self) -> canopen::Instant {
        at(self.now.as_millis() as u32)
    }

    /// An answer of the device, as it arrives.
    fn answer(&mut self, frame: Frame) {
        match self.byte() {
            None | Some(0..=159) => self.answers.push_back(frame),
            Some(160..=169) => {}
            Some(170..=179) => self.answers.extend([frame, frame]),
            // One byte of it is another one.
            Some(180..=229) => {
                let mut data = frame.data().to_vec();
                let (place, value) = (self.byte().unwrap_or(0), self.byte().unwrap_or(0));
                if let Some(byte) = data.get_mut(usize::from(place & 7)) {
                    *byte = value;
                }
                self.answers.push_back(Frame::of(frame.cob_id().expect("11 bits"), &data));
            }
            Some(230..=239) => {
                let len = usize::from(self.byte().unwrap_or(0)) % 9;
                let data: Vec<u8> = (0..len).map(|_| self.byte().unwrap_or(0)).collect();
                self.answers.push_back(Frame::of(frame.cob_id().expect("11 bits"), &data));
            }
            Some(_) => {
                self.answers.push_back(frame);
                self.foreign();
            }
        }
    }

    /// A frame that nobody has asked for.
    fn foreign(&mut self) {
        let kind = self.byte().unwrap_or(0);
        let id = match kind & 3 {
            0 => CobId::sdo_response(node()),
            1 => CobId::heartbeat(node()),
            2 => CobId::LSS_RESPONSE,
            _ => CobId::new(u16::from(self.byte().unwrap_or(0)) << 3).expect("11 bits"),
        };
        let len = if kind & 4 != 0 { 8 } else { usize::from(kind >> 3) % 9 };
        let data: Vec<u8> = (0..len).map(|_| self.byte().unwrap_or(0)).collect();
        self.answers.push_back(Frame::of(id, &data));
    }

    fn poll(&mut self) {
        while let Some(frame) = self.slave.poll(self.millis(), &mut self.device) {
            self.answer(frame);
        }
    }
}

impl Adapter for Hostile<'_> {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        self.now += FRAME;
        self.slave.handle(frame, self.millis(), &mut self.device);
        self.poll();
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        assert!(self.now < MOST, "the checks do not end");
        if let Some(frame) = self.answers.pop_front() {
            self.now += FRAME;
            return Ok(Some(frame));
        }
        if timeout.is_zero() {
            return Ok(None);
        }
        if let Some(250..) = self.byte() {
            self.foreign();
            self.now += timeout.min(Duration::from_millis(10));
        } else {
            self.now += timeout;
            self.poll();
        }
        Ok(self.answers.pop_front())
    }

    fn now(&self) -> Duration {
        self.now
    }
}

/// A program of some bytes, for the checks that install one.
fn program() -> Payload {
    static PROGRAM: OnceLock<Payload> = OnceLock::new();
    PROGRAM
        .get_or_init(|| {
            let hex = b":020000040801F1\n:04000000EFBEADDEC4\n:00000001FF\n";
            let firmware = coflash_core::file::read(hex, None, None).expect("Intel HEX");
            let options = Options::default().region(Region::Unknown);
            Arc::new(program_of(firmware, &options).expect("a program").program).into()
        })
        .clone()
}

coboot_fuzz::target!(|bytes: &[u8]| {
    let mut input = Input::new(bytes);
    let Some([flags, first, count]) = input.array() else { return };
    let checks = checks();
    let first = usize::from(first) % checks.len();
    let last = checks.len().min(first + 1 + usize::from(count) % 16);
    let all = input.rest();
    let mut hostile = Hostile {
        now: Duration::ZERO,
        all,
        input: Input::new(all),
        endless: flags & 1 != 0,
        slave: Node::new(node(), Config { nmt: NmtPolicy::Follow, ..Config::default() }),
        device: Device::default(),
        answers: VecDeque::new(),
    };
    let mut means = Means::of(Duration::from_millis(if flags & 2 != 0 { 50 } else { 1000 }));
    means.image = (flags & 4 != 0).then(program);
    let cancelled = Arc::new(AtomicBool::new(false));
    let mut reported = 0;
    let verdicts = run(&mut hostile, node(), &checks[first..last], means, &cancelled, &mut |_| reported += 1)
        .expect("the bus is there");
    assert_eq!((verdicts.len(), reported), (last - first, last - first));
    for verdict in verdicts {
        if let Outcome::Failed(words) | Outcome::Skipped(words) = verdict.outcome {
            assert!(!words.is_empty(), "{}", verdict.check.id);
        }
    }
});
