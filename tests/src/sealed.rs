//! A device that accepts only sealed images, on the flash model: its trusted keys, the files for
//! it, and the permitted contents of its flash.

use std::ops::{Deref, DerefMut};

use boot_core::bootloader::Everything;
use boot_core::canopen::od::Address;
use boot_core::canopen::{AbortCode, Instant};
use boot_core::control::SealedMemory;
use boot_core::crc::CrcKind;
use boot_core::decision::{Exit, Start};
use boot_core::program::{verify, Invalid, VerifiedProgram};
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord};
use coflash_core::file::sealed::SigningKey;
use seal::access::{right, CHALLENGE, EVENTS};
use shared_abi::geometry::Region;
use shared_abi::handoff::ResetCause;
use shared_abi::warm_start::BootRequest;

use attack::model::{choice, FIRST};
use kit::boot::Boot;
use kit::model::{Chip, ModelFlash, CHIP};
use kit::rig::{go_on, Node, BOARD_NODE};

pub use attack::sealed::*;
pub use kit::bench::{CLEAR, CLR_SIGNATURE, SET_SIGNATURE, START};
pub use kit::rig::sealed::*;
pub use kit::rig::{block, crc32, Setup, PRODUCT_CODE, REVISION, UNIQUE_ID, VENDOR_ID};

/// A device without power, or with power in [`run`](Self::run).
pub struct Device {
    /// Its configuration.
    pub setup: &'static Setup,
    /// Its flash.
    pub chip: Chip,
    /// Bytes of buffer between bus and flash.
    pub buffer: usize,
}

impl Device {
    /// A device with this flash.
    pub fn on(setup: &'static Setup, flash: ModelFlash) -> Self {
        Self { setup, chip: Chip::new(flash), buffer: 2048 }
    }

    /// A device with empty flash except this key block.
    pub fn with_keys(setup: &'static Setup, block: &[u8; 256]) -> Self {
        let mut flash = ModelFlash::new(&CHIP);
        flash.poke(setup.layout.key_block().base, block);
        Self::on(setup, flash)
    }

    /// A device with empty flash except [`default_keys`].
    pub fn sealed(setup: &'static Setup) -> Self {
        Self::with_keys(setup, &default_keys())
    }

    /// A device with empty flash.
    pub fn open(setup: &'static Setup) -> Self {
        Self::on(setup, ModelFlash::new(&CHIP))
    }

    /// Another device with the same flash contents.
    pub fn copy(&self) -> Self {
        let mut flash = self.chip.model().clone();
        flash.power_on();
        flash.touched.clear();
        Self { buffer: self.buffer, ..Self::on(self.setup, flash) }
    }

    /// Power on, bootloader mode, and a host that talks to it; then power off.
    pub fn run<R>(&self, talk: impl FnOnce(&mut Host<'_>) -> R) -> R {
        let flash = self.chip.clone();
        let parameters = Journal::open(&flash, self.setup.layout.parameters);
        let node = NodeParameters::load(&parameters, &flash, BOARD_NODE, |_| true);
        let mut buffer = vec![0; self.buffer];
        let mut room = Box::<SealedMemory>::default();
        let boot = Boot::new(&self.setup.config, node);
        let node: Box<dyn Node + '_> = match self.setup.programs() {
            1 => Box::new(boot.with::<_, _, 1, Everything>(parameters, flash, &mut buffer, room.sealed())),
            _ => Box::new(boot.with::<_, _, 2, Everything>(parameters, flash, &mut buffer, room.sealed())),
        };
        let result = talk(&mut Host { device: self, node, now: 0 });
        self.chip.model().power_on();
        result
    }

    fn parameters(&self) -> Journal {
        Journal::open(&self.chip, self.setup.layout.parameters)
    }

    /// The boot stage's check of a program.
    ///
    /// # Errors
    /// The reason why the boot stage does not start it.
    pub fn verified(&self, program: u8) -> Result<VerifiedProgram, Invalid> {
        verify(&self.chip, &self.parameters(), self.setup.layout, CrcKind::Crc32, program)
    }

    /// The record of a program.
    pub fn record(&self, program: u8) -> Option<ProgramRecord> {
        self.parameters().program(&self.chip, program)
    }

    /// The lowest counter stored for a program.
    pub fn counter(&self, program: u8) -> u32 {
        self.parameters().get(&self.chip, Key::counter(program)).map_or(0, |[counter, ..]| counter)
    }

    /// The program that the boot stage starts.
    pub fn starts(&self, request: Option<BootRequest>) -> Option<u8> {
        let reset = (ResetCause::PowerOn, request);
        match choice(&self.chip, &self.parameters(), self.setup.layout, FIRST, reset).exit {
            Exit::Program(Start { number, .. }) => Some(number),
            Exit::Bootloader { .. } | Exit::Again | Exit::Choose => None,
        }
    }

    /// The first bytes of a program's flash.
    pub fn cells(&self, program: u8, len: usize) -> Vec<u8> {
        let base = self.setup.region(program).base;
        self.chip.model().cells(Region::new(base, len as u32)).to_vec()
    }

    /// Whether the boot stage accepts the program, it is this image, and all its bits are stable.
    #[must_use]
    pub fn holds(&self, program: u8, image: &[u8]) -> bool {
        let place = Region::new(self.setup.region(program).base, image.len() as u32);
        self.verified(program).is_ok()
            && self.cells(program, image.len()) == image
            && self.chip.model().is_stable(place)
    }

    /// The regions that were erased or written since the last call, except the journal, which
    /// records events.
    pub fn take_touched(&self) -> Vec<Region> {
        let mut touched = std::mem::take(&mut self.chip.model().touched);
        let journal = self.setup.layout.parameters;
        touched.retain(|region| !journal.iter().any(|place| place.contains(region.base, region.size)));
        touched
    }

    /// Whether the flash of a program was changed since the last call.
    pub fn was_touched(&self, program: u8) -> bool {
        let region = self.setup.region(program);
        self.take_touched().iter().any(|touched| region.contains(touched.base, touched.size))
    }
}

/// A host that talks to the bootloader.
pub struct Host<'a> {
    /// The device.
    pub device: &'a Device,
    /// Its bootloader.
    pub node: Box<dyn Node + 'a>,
    /// The time in ms.
    pub now: u32,
}

impl<'a> Deref for Host<'a> {
    type Target = dyn Node + 'a;

    fn deref(&self) -> &Self::Target {
        &*self.node
    }
}

impl DerefMut for Host<'_> {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut *self.node
    }
}

impl Host<'_> {
    /// A command, carried out; gives the status.
    pub fn commanded(&mut self, program: u8, command: u8) -> u32 {
        self.command(program, command).expect("the command is taken");
        self.settle();
        self.status(program)
    }

    /// Password or CLEAR: a download may begin.
    pub fn clear(&mut self, program: u8) {
        match self.device.setup.password(program) {
            None => drop(self.commanded(program, CLEAR)),
            Some((at, password)) => self.node.write(at, password).expect("it is right"),
        }
        self.settle();
    }

    /// Begins a download and sends these bytes in pieces of this size.
    ///
    /// # Errors
    /// The abort.
    pub fn begin(&mut self, program: u8, data: &[u8], piece: usize) -> Result<(), AbortCode> {
        let at = Address::new(0x1F50, program);
        self.node.download_start(at, None)?;
        self.go_on(program, data, piece)
    }

    /// Sends more bytes.
    ///
    /// # Errors
    /// The abort.
    pub fn go_on(&mut self, program: u8, data: &[u8], piece: usize) -> Result<(), AbortCode> {
        go_on(&mut *self.node, program, data, piece)
    }

    /// A download with all its work; returns the abort, if any, and the status.
    pub fn send(&mut self, program: u8, data: &[u8], piece: usize) -> (Result<(), AbortCode>, u32) {
        let outcome = self.begin(program, data, piece).and_then(|()| self.end(program));
        self.settle();
        (outcome, self.status(program))
    }

    /// 2002h/1: unique ID, nonce, and the word with the rights.
    pub fn challenge(&mut self) -> [u8; CHALLENGE] {
        let mut challenge = [0; CHALLENGE];
        self.node.read(Address::new(0x2002, 1), &mut challenge).expect("it can be read");
        challenge
    }

    /// The granted rights, and [`SEALED`](seal::access::SEALED).
    pub fn rights(&mut self) -> u32 {
        u32::from_le_bytes([44, 45, 46, 47].map(|at| self.challenge()[at]))
    }

    /// A request for rights, signed by this key for the present challenge.
    pub fn request(&mut self, root: &SigningKey, rights: u32, argument: u32) -> Vec<u8> {
        request(&self.challenge(), root, rights, argument)
    }

    /// An event of 2003h; 1 is the latest.
    pub fn event(&mut self, sub: u8) -> [u32; 4] {
        let mut bytes = [0; 16];
        assert_eq!(self.read(Address::new(0x2003, sub), &mut bytes), Ok(16));
        [0, 4, 8, 12].map(|at| seal::wire::word(&bytes, at))
    }

    /// All events, the latest first.
    pub fn log(&mut self) -> Vec<[u32; 4]> {
        (1..=EVENTS as u8).map(|sub| self.event(sub)).collect()
    }

    /// Sends a request for rights (2002h/2), without waiting for its check.
    ///
    /// # Errors
    /// The abort.
    pub fn ask(&mut self, request: &[u8]) -> Result<(), AbortCode> {
        self.node.write(Address::new(0x2002, 2), request)
    }

    /// The holder of a root asks for rights; returns whether they are granted.
    pub fn grant(&mut self, root: &SigningKey, rights: u32, argument: u32) -> bool {
        let request = self.request(root, rights, argument);
        let asked = self.ask(&request);
        self.settle();
        asked.is_ok() && self.rights() & rights == rights
    }

    /// A client with the right to do so erases the program.
    pub fn erase(&mut self, program: u8) {
        assert!(self.grant(&keys().root, right::ERASE, 0));
        for _ in 0..2 {
            assert_eq!(self.commanded(program, CLEAR), 0);
        }
    }

    /// Waits long enough that no earlier failure delays the next attempt.
    pub fn wait(&mut self) {
        self.now += 100_000;
        self.node.set_time(Instant::from_millis(self.now));
    }

    /// The same after password or CLEAR.
    pub fn update(&mut self, program: u8, data: &[u8], piece: usize) -> (Result<(), AbortCode>, u32) {
        self.wait();
        self.clear(program);
        self.send(program, data, piece)
    }

    /// A good image.
    pub fn install(&mut self, program: u8, data: &[u8]) {
        assert_eq!(self.update(program, data, 7), (Ok(()), 0), "a good image is taken");
        self.node.take_boot_request();
    }

    /// The program has returned the device to the bootloader.
    pub fn confirm(&mut self, program: u8) {
        self.node.confirm(program);
        self.settle();
    }

    /// START; returns the program that the boot stage then starts.
    pub fn start(&mut self, program: u8) -> Option<u8> {
        self.command(program, START).ok()?;
        let request = self.node.take_boot_request()?;
        self.device.starts(Some(request))
    }
}
