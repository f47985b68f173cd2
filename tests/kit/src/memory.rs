//! A device with the debugger interface, and a memory that fails the test if it is accessed without
//! permission.

use core::task::Poll;

use canopen::debugger::{Command, Debugger, Kind, Memory, ENTRIES, PIECE};
use canopen::frame::Channel;
use canopen::lss::{LssDevice, StoreError};
use canopen::node::{Config, Node};
use canopen::od::{put, Entry};
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, Address, BitRate, Frame, NodeId, Objects};

use crate::bus::{at, node, request};

/// RAM of this size; a ROM of the same size lies before it.
pub const SIZE: u32 = 0x1000;
pub const RAM: u32 = 0x2000_0000;
pub const ROM: u32 = RAM - SIZE;

#[derive(Debug)]
pub struct Model {
    pub ram: Vec<u8>,
    pub rom: Vec<u8>,
    pub locked: bool,
    /// The result of an access.
    pub refuse: Option<AbortCode>,
    /// The last permitted command.
    allowed: Option<Command>,
    /// Address and length of every access.
    pub touched: Vec<(Kind, u32, usize)>,
}

impl Default for Model {
    fn default() -> Self {
        let noise =
            |seed: u32| (0..SIZE).map(|i| (i.wrapping_mul(167).wrapping_add(seed) >> 3) as u8).collect();
        Self { ram: noise(1), rom: noise(2), locked: false, refuse: None, allowed: None, touched: Vec::new() }
    }
}

impl Model {
    fn note(&mut self, kind: Kind, address: u32, len: usize) {
        assert!(!self.locked, "a locked memory is touched");
        let allowed = self.allowed.expect("touched before anything was allowed");
        assert_eq!(kind, allowed.kind);
        assert!((1..=PIECE).contains(&len), "{len} bytes at once");
        let offset = u64::from(address) - u64::from(allowed.address);
        assert!(
            offset % PIECE as u64 == 0 && offset + len as u64 <= u64::from(allowed.len),
            "{offset} {len}"
        );
        self.touched.push((kind, address, len));
    }
}

impl Memory for Model {
    fn is_locked(&mut self) -> bool {
        self.locked
    }

    fn allows(&mut self, command: &Command) -> bool {
        let base = if command.kind == Kind::Read { ROM } else { RAM };
        let end = u64::from(command.address) + u64::from(command.len);
        let allowed = command.address >= base && end <= u64::from(RAM + SIZE);
        self.allowed = allowed.then_some(*command);
        allowed
    }

    fn read(&mut self, address: u32, bytes: &mut [u8]) -> Result<(), AbortCode> {
        self.note(Kind::Read, address, bytes.len());
        if let Some(code) = self.refuse {
            return Err(code);
        }
        let both = [&self.rom[..], &self.ram[..]].concat();
        bytes.copy_from_slice(&both[(address - ROM) as usize..][..bytes.len()]);
        Ok(())
    }

    fn write(&mut self, address: u32, bytes: &[u8]) -> Result<(), AbortCode> {
        self.note(Kind::Write, address, bytes.len());
        if let Some(code) = self.refuse {
            return Err(code);
        }
        self.ram[(address - RAM) as usize..][..bytes.len()].copy_from_slice(bytes);
        Ok(())
    }
}

/// The device of the interface.
#[derive(Debug, Default)]
pub struct Plain {
    pub register: u8,
    pub emergency: Option<[u8; 8]>,
    /// The COB-IDs of its second SDO server, if it has one.
    pub second: Option<Channel>,
}

impl Objects for Plain {
    fn has_second_server() -> bool {
        true
    }

    fn entries(&self) -> &'static [Entry] {
        &ENTRIES
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        match at.index {
            0x1001 => put(buf, &[self.register]),
            _ => panic!("{at} is none of its objects"),
        }
    }

    fn second_server(&self) -> Channel {
        self.second.unwrap_or(Channel::NONE)
    }

    fn next_emergency(&mut self) -> Option<[u8; 8]> {
        self.emergency.take()
    }
}

impl LssDevice for Plain {
    fn supports(&mut self, _: BitRate) -> bool {
        true
    }

    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Ok(()))
    }
}

impl SlaveDevice for Plain {}

/// The device on a bus.
pub struct Target {
    pub node: Node,
    pub debugger: Debugger<Model>,
    pub device: Plain,
}

impl Target {
    pub fn new() -> Self {
        let mut target = Self {
            node: Node::new(node(), Config::default()),
            debugger: Debugger::new(Model::default()),
            device: Plain::default(),
        };
        assert!(target.poll(0).is_some(), "the boot-up");
        target
    }

    pub fn handle(&mut self, frame: &Frame, now: u32) {
        let mut device = self.debugger.attach(&mut self.device);
        self.node.handle(frame, at(now), &mut device);
    }

    pub fn poll(&mut self, now: u32) -> Option<Frame> {
        let mut device = self.debugger.attach(&mut self.device);
        self.node.poll(at(now), &mut device)
    }

    /// Sends a request; returns the answers.
    pub fn ask(&mut self, bytes: [u8; 8]) -> [u8; 8] {
        self.handle(&request(bytes), 0);
        *self.poll(0).expect("an answer").exactly().expect("8 bytes")
    }

    pub fn model(&mut self) -> &mut Model {
        self.debugger.memory()
    }
}
