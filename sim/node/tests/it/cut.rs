//! A bus in virtual time with a bootloader on the model of the flash, which can be cut.

use std::collections::VecDeque;
use std::io;
use std::time::Duration;

use boot_core::bootloader::{Bootloader, Config};
use boot_core::canopen::node::NmtPolicy;
use boot_core::canopen::slave::{self, Output, Slave};
use boot_core::canopen::{CobId, Frame, Instant, NodeId};
use boot_core::control::Step;
use boot_core::store::Journal;
use coboot_can::{Adapter, AdapterError};

use kit::bench::{node, CONFIG};
use kit::boot::{leaked, Boot};
use kit::model::{until_power_cut, Chip, Cut, ModelFlash};

/// The bytes of blocks that may wait for the flash.
const BUFFER: usize = 4096;
/// A frame with 8 bytes at 1 Mbit/s.
const FRAME: Duration = Duration::from_micros(130);
/// How far the time goes in one step if nothing is on the bus.
const STEP: Duration = Duration::from_millis(1);
/// The steps of the bootloader in a frame's time, and in a step of the time.
const WORK: u32 = 24;

/// The way in which an update is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// The host stops instead of sending this frame, counted from 0.
    Host(u32),
    /// From this frame of the host on, frames are lost in both directions.
    Bus(u32),
    /// The device's power is cut in this operation of its flash, counted from 1.
    Power(u32, Cut),
}

/// What a frame of the host belongs to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sending {
    /// No download to 1F50h.
    Other,
    /// Segments, with toggle bits.
    Segments,
    /// Sub-blocks; the number of the segment that ends the download, if it was sent.
    Blocks(Option<u8>),
    /// The end of a block download.
    End,
}

/// The bus.
pub struct CutBus {
    chip: Chip,
    /// `None` while its power is off.
    running: Option<(Bootloader<'static, Chip, Journal, 1>, Slave)>,
    now: Duration,
    sent: VecDeque<Frame>,
    way: Option<Way>,
    sending: Sending,
    /// Frames that the host has sent.
    pub frames: u32,
    /// Data bytes that the host has sent in downloads to 1F50h.
    pub data: usize,
}

impl CutBus {
    /// A device with this flash, switched on. It is cut in this way.
    pub fn new(flash: ModelFlash, way: Option<Way>) -> Self {
        let chip = Chip::new(flash);
        let mut bus = Self {
            chip,
            running: None,
            now: Duration::ZERO,
            sent: VecDeque::new(),
            way: None,
            sending: Sending::Other,
            frames: 0,
            data: 0,
        };
        bus.power_on();
        bus.way = way;
        if let Some(Way::Power(operation, cut)) = way {
            bus.chip.model().cut = Some((operation, cut));
        }
        bus
    }

    /// The cut is over: the host and the bus work again after a pause, and the device has power.
    pub fn repair(&mut self, pause: Duration) {
        self.way = None;
        self.sent.clear();
        (self.frames, self.data, self.sending) = (0, 0, Sending::Other);
        if self.running.is_none() {
            self.power_on();
        }
        self.chip.model().cut = None;
        let until = self.now + pause;
        while self.now < until {
            self.pass(STEP);
        }
        self.sent.clear();
    }

    /// The flash, as a debug probe sees it.
    pub fn flash(&self) -> std::cell::RefMut<'_, ModelFlash> {
        self.chip.model()
    }

    fn power_on(&mut self) {
        self.chip.model().power_on();
        let config: &'static Config = &const { CONFIG };
        let (buffer, sealed) = leaked(BUFFER);
        let device = Boot::new(config, node()).on(self.chip.clone(), buffer, sealed);
        let says = slave::Config::default();
        let says = slave::Config {
            node: boot_core::canopen::node::Config {
                nmt: NmtPolicy::StayPreOperational,
                heartbeat_ms: 0,
                ..says.node
            },
            ..says
        };
        let slave = Slave::new(device.lss_address(), node().id, node().bit_rate, says);
        self.running = Some((device, slave));
        self.pass(STEP);
    }

    fn is_lost(&self) -> bool {
        matches!(self.way, Some(Way::Bus(frame)) if self.frames > frame)
    }

    /// The time passes, and the device works.
    fn pass(&mut self, time: Duration) {
        self.now += time;
        let now = Instant::from_millis(self.now.as_millis() as u32);
        let Some((device, slave)) = &mut self.running else { return };
        let sent = &mut self.sent;
        let lost = until_power_cut(|| {
            device.set_time(now);
            for _ in 0..WORK {
                if device.step() == Step::Idle {
                    break;
                }
            }
            while let Some(output) = slave.poll(now, true, device) {
                if let Output::Send(frame) = output {
                    sent.push_back(frame);
                }
            }
        });
        if lost {
            self.running = None;
        }
        if self.is_lost() || lost {
            self.sent.clear();
        }
    }

    /// Counts the data of a frame of the host (CiA 301, 7.2.4.3).
    fn count(&mut self, bytes: [u8; 8]) {
        let unused = |bits: u8| 7 - usize::from(bits & 7);
        let is_data = bytes[1..3] == [0x50, 0x1F];
        match (self.sending, bytes[0]) {
            (_, 0x80) => self.sending = Sending::Other,
            (Sending::Blocks(_), command) if command & 0x7F != 0 && self.sending != Sending::End => {
                self.data += 7;
                if command & 0x80 != 0 {
                    self.sending = Sending::Blocks(Some(command & 0x7F));
                }
            }
            (Sending::End, command) if command & 0xE3 == 0xC1 => {
                self.data -= usize::from(command >> 2 & 7);
                self.sending = Sending::Other;
            }
            (Sending::Segments, command) if command & 0xE0 == 0 => self.data += unused(command >> 1),
            (_, 0x21) if is_data => self.sending = Sending::Segments,
            (_, 0xC2 | 0xC6) if is_data => self.sending = Sending::Blocks(None),
            _ => self.sending = Sending::Other,
        }
    }

    /// Follows the answers of the device, for the end of a block download.
    fn follow(&mut self, bytes: [u8; 8]) {
        match (self.sending, bytes[0]) {
            (_, 0x80) => self.sending = Sending::Other,
            (Sending::Blocks(Some(last)), 0xA2) => {
                self.sending = if bytes[1] == last { Sending::End } else { Sending::Blocks(None) };
            }
            _ => {}
        }
    }
}

impl Adapter for CutBus {
    fn send(&mut self, frame: &Frame) -> Result<(), AdapterError> {
        if matches!(self.way, Some(Way::Host(stop)) if self.frames >= stop) {
            let source = io::Error::from(io::ErrorKind::NotConnected).into();
            return Err(AdapterError::Lost { adapter: "the host".into(), source });
        }
        self.frames += 1;
        let id = NodeId::new(5).expect("a node-ID");
        if let Some(bytes) = frame.exactly().filter(|_| frame.has_cob_id(CobId::sdo_request(id))) {
            self.count(*bytes);
        }
        if !self.is_lost() {
            let now = Instant::from_millis(self.now.as_millis() as u32);
            let lost = match &mut self.running {
                Some((device, slave)) => until_power_cut(|| {
                    slave.handle(frame, now, device);
                }),
                None => false,
            };
            if lost {
                self.running = None;
            }
        }
        self.pass(FRAME);
        Ok(())
    }

    fn receive(&mut self, timeout: Duration) -> Result<Option<Frame>, AdapterError> {
        let until = self.now + timeout;
        loop {
            if let Some(frame) = self.sent.pop_front() {
                if let Some(bytes) = frame.exactly::<8>() {
                    self.follow(*bytes);
                }
                return Ok(Some(frame));
            }
            if self.now >= until {
                return Ok(None);
            }
            self.pass(STEP.min(until - self.now));
        }
    }

    fn now(&self) -> Duration {
        self.now
    }
}
