//! A CAN controller of one's own: the example of `docs/can-driver.md`, on a virtual bus, with the
//! bootloader behind it.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::rc::Rc;

use boot_core::bootloader::{Bootloader, Config};
use boot_core::store::Journal;
use bsp::can::{Errors, Lost, Mode};
use bsp::can_driver::CanDriver;
use bsp::line;
use canopen::node::{self, NmtPolicy};
use canopen::slave::{self, Slave};
use canopen::{BitRate, CobId, Frame, Instant, NodeId};
use embedded_can::Frame as _;
use kit::bench::CONFIG;
use kit::boot::{leaked, Boot};
use kit::model::{Chip, ModelFlash, CHIP};

/// The registers of a controller with two receive buffers and one transmit buffer, and its bus.
#[derive(Default)]
pub struct Registers {
    /// What the bus has: frames that were sent and acknowledged.
    pub on_bus: Vec<Frame>,
    /// Whether another node acknowledges.
    pub has_listener: bool,
    /// Bus-off.
    pub is_off: bool,
    pub rate: Option<(BitRate, Mode)>,
    /// The acceptance filter.
    pub accepted: Vec<u16>,
    receive: VecDeque<Frame>,
    transmit: Option<Frame>,
    overrun: bool,
    recovers: bool,
}

impl Registers {
    /// A frame of another node.
    pub fn arrives(&mut self, frame: Frame) {
        let is_for_us = self.accepted.contains(&frame.cob_id().map_or(u16::MAX, CobId::get));
        if self.rate.is_none() || self.is_off || !is_for_us {
            return;
        }
        if self.receive.len() == 2 {
            self.overrun = true;
        } else {
            self.receive.push_back(frame);
        }
    }

    /// Time passes on the bus: a waiting frame is sent if somebody acknowledges it.
    pub fn passes(&mut self) {
        let sends = matches!(self.rate, Some((_, Mode::Normal))) && self.has_listener && !self.is_off;
        if sends {
            self.on_bus.extend(self.transmit.take());
        }
        // 128 × 11 recessive bits.
        self.is_off &= !std::mem::take(&mut self.recovers);
    }
}

/// The driver.
pub struct Driver {
    registers: Rc<RefCell<Registers>>,
    /// The owner's queue was full.
    no_room: bool,
    /// A good frame came since the state was read.
    heard: bool,
}

impl CanDriver for Driver {
    fn set_bit_rate(&mut self, rate: BitRate, mode: Mode) {
        let mut registers = self.registers.borrow_mut();
        registers.transmit = None;
        registers.rate = Some((rate, mode));
    }

    fn recover_from_bus_off(&mut self) {
        self.registers.borrow_mut().recovers = true;
    }

    fn accept<const N: usize>(&mut self, identifiers: [u16; N]) {
        self.registers.borrow_mut().accepted = identifiers.to_vec();
    }

    fn receive(&mut self) -> Option<Frame> {
        let frame = self.registers.borrow_mut().receive.pop_front();
        self.heard |= frame.is_some();
        frame
    }

    fn record_overrun(&mut self) {
        self.no_room = true;
    }

    // One buffer keeps the order of all frames. With more of them, two frames of one identifier must not
    // be in buffers at the same time, unless the controller sends them in the order of the calls.
    fn has_room(&mut self) -> bool {
        self.registers.borrow().transmit.is_none()
    }

    fn send(&mut self, frame: &Frame) {
        self.registers.borrow_mut().transmit = Some(*frame);
    }

    fn is_idle(&mut self) -> bool {
        self.registers.borrow().transmit.is_none()
    }

    fn errors(&mut self) -> Errors {
        let registers = self.registers.borrow();
        let last = std::mem::take(&mut self.heard).then_some(Ok(()));
        Errors { off: registers.is_off, passive: registers.is_off, joined: registers.rate.is_some(), last }
    }

    fn take_overruns(&mut self) -> Lost {
        let in_controller = std::mem::take(&mut self.registers.borrow_mut().overrun);
        Lost { in_controller, in_queue: std::mem::take(&mut self.no_room) }
    }
}

/// A bootloader with this controller, driven as the firmware drives it.
struct Board {
    registers: Rc<RefCell<Registers>>,
    can: Driver,
    slave: Slave,
    device: Bootloader<'static, Chip, Journal, 1>,
    now: u32,
}

const NODE: u8 = 5;

impl Board {
    fn new() -> Self {
        let (buffer, sealed) = leaked(256);
        let config: &Config = Box::leak(Box::new(CONFIG));
        let device: Bootloader<'_, _, _, 1> =
            Boot::new(config, kit::bench::node()).on(Chip::new(ModelFlash::new(&CHIP)), buffer, sealed);
        let node = node::Config { nmt: NmtPolicy::StayPreOperational, ..node::Config::default() };
        let config = slave::Config { node, ..slave::Config::default() };
        let slave = Slave::new(device.lss_address(), NodeId::new(NODE), BitRate::K125, config);
        let registers = Rc::new(RefCell::new(Registers { has_listener: true, ..Registers::default() }));
        let can = Driver { registers: registers.clone(), no_room: false, heard: false };
        Self { registers, can, slave, device, now: 0 }
    }

    /// What the firmware does after an interrupt of the controller, and every few milliseconds.
    fn serve(&mut self) {
        let Self { can, slave, device, .. } = self;
        let now = Instant::from_millis(self.now);
        device.set_time(now);
        let mut received = Vec::new();
        line::receive(can, |frame| {
            received.push(frame);
            true
        });
        let status = line::status(can);
        slave.observe(status, now, device);
        let mut carry_out = |slave: &mut Slave, device: &mut _| {
            while let Some(output) = slave.poll(now, can.has_room(), device) {
                line::carry_out(can, output);
            }
        };
        carry_out(slave, device);
        for frame in received {
            slave.handle(&frame, now, device);
            carry_out(slave, device);
        }
    }

    /// Some milliseconds: the device is served in each, and the bus goes on.
    fn wait(&mut self, ms: u32) {
        for _ in 0..ms {
            self.now += 1;
            self.serve();
            self.registers.borrow_mut().passes();
        }
    }

    fn arrives(&mut self, id: u16, data: &[u8]) {
        self.registers.borrow_mut().arrives(Frame::of(CobId::new(id).unwrap(), data));
    }

    /// The frames on the bus since the last call, by identifier.
    fn sent(&mut self) -> Vec<(u16, Vec<u8>)> {
        let frames = std::mem::take(&mut self.registers.borrow_mut().on_bus);
        let parts = |frame: Frame| (frame.cob_id().unwrap().get(), frame.data().to_vec());
        frames.into_iter().map(parts).collect()
    }
}

/// CiA 301: boot-up 700h + node-ID; SDO request 600h and answer 580h + node-ID; NMT 0; LSS 7E5h.
#[test]
fn the_slave_sets_bit_rate_and_filters_and_is_served() {
    let mut board = Board::new();
    board.wait(5);
    assert_eq!(board.registers.borrow().rate, Some((BitRate::K125, Mode::Normal)));
    let accepted = board.registers.borrow().accepted.clone();
    assert!([0, 0x605, 0x7E5].iter().all(|id| accepted.contains(id)), "{accepted:X?}");
    assert_eq!(board.sent(), [(0x705, vec![0])]);
    // A read of 1000h, beside a request to another node.
    board.arrives(0x606, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    board.arrives(0x605, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    board.wait(5);
    assert_eq!(board.sent(), [(0x585, vec![0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10])]);
}

/// CiA 301 table 26: 8110h, CAN overrun; the driver status 0020h is SYS TEC's (L-1112d_10, 3.4.9).
#[test]
fn a_frame_that_the_controller_lost_is_reported() {
    let mut board = Board::new();
    board.wait(5);
    board.sent();
    for _ in 0..3 {
        board.arrives(0x605, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    }
    board.wait(5);
    let emergencies: Vec<_> = board.sent().into_iter().filter(|(id, _)| *id == 0x085).collect();
    let (_, data) = emergencies.first().expect("an emergency");
    assert_eq!(data[..2], 0x8110_u16.to_le_bytes());
    assert!(data[3..].windows(2).any(|bytes| bytes == 0x0020_u16.to_le_bytes()), "{data:X?}");
}

/// Without another node nothing is lost and nothing hangs: the answer is there when one comes.
#[test]
fn frames_wait_for_room_in_their_order() {
    let mut board = Board::new();
    board.registers.borrow_mut().has_listener = false;
    board.wait(5);
    assert!(!board.can.has_room() && !board.can.is_idle());
    board.arrives(0x605, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    board.wait(50);
    assert_eq!(board.sent(), []);
    board.registers.borrow_mut().has_listener = true;
    board.wait(5);
    let ids: Vec<u16> = board.sent().iter().map(|(id, _)| *id).collect();
    assert_eq!(ids, [0x705, 0x585]);
    assert!(board.can.is_idle());
}

/// The slave begins the recovery, 200 ms after bus-off (canopen::line), and not the controller.
#[test]
fn the_slave_decides_when_to_leave_bus_off() {
    let mut board = Board::new();
    board.wait(5);
    board.sent();
    board.registers.borrow_mut().is_off = true;
    board.wait(190);
    assert!(board.registers.borrow().is_off && !board.registers.borrow().recovers);
    board.wait(20);
    assert!(!board.registers.borrow().is_off);
    board.arrives(0x605, &[0x40, 0x00, 0x10, 0, 0, 0, 0, 0]);
    board.wait(5);
    assert!(board.sent().contains(&(0x585, vec![0x43, 0x00, 0x10, 0, 0, 0, 0, 0x10])));
}
