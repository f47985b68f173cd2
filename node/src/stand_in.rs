//! The replacement of a program: no CPU can run the program in the file. The stand-in answers the
//! requests that a host sends to a running application (CiA 302-3): which program runs (1F51h) and
//! its identification (1F56h). It accepts the commands of 1F51h like the application template.

use std::task::Poll;

use boot_core::canopen::application::{react, Reaction, Standing};
use boot_core::canopen::device::{self, Device};
use boot_core::canopen::lss::{LssAddress, LssDevice, StoreError};
use boot_core::canopen::od::{put, Address, Entry, Objects};
use boot_core::canopen::program::{
    region_value, FlashStatus, ProgramControl, ProgramState, CONTROL_ARRAYS, FLASH_STATUS, PROGRAM_CONTROL,
    PROGRAM_ID, PROGRAM_REGION, PROGRAM_VERSION,
};
use boot_core::canopen::slave::SlaveDevice;
use boot_core::canopen::{AbortCode, BitRate, NodeId};
use boot_core::flash::run;
use boot_core::store::{Journal, Key, Parameters as _, ProgramRecord};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;
use shared_abi::warm_start::{BootRequest, Owed};

use crate::file_flash::FileFlash;

/// 1000h: no standardised profile, and not the bootloader's value.
const DEVICE_TYPE: u32 = 0;
/// 100Ah. It must not look like the program itself.
const SOFTWARE_VERSION: &str = "coboot-node stand-in";

/// How the device leaves after a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leave {
    /// The program has answered, and the bootloader gets this request.
    Answered(BootRequest),
    /// The bootloader must answer.
    Owed(Owed),
}

/// The program that it replaces, and the circumstances of its start.
#[derive(Clone, Copy, Debug)]
pub struct Started {
    /// Its number.
    pub program: u8,
    /// It was started directly after a download in one transfer: the first 80h confirms it.
    pub fresh: bool,
    /// The active node-ID, if the bootloader has the same one and can answer in the program's
    /// place.
    pub bootloader_answers: Option<NodeId>,
}

/// The stand-in for a program.
#[derive(Debug)]
pub struct StandIn {
    entries: &'static [Entry],
    device: Device,
    started: Started,
    flash: FileFlash,
    /// The places of programs and journal.
    layout: &'static Layout,
    leave: Option<Leave>,
}

impl StandIn {
    /// The stand-in for this program, on a device with this flash and this identity of the
    /// bootloader.
    #[must_use]
    pub fn new(
        entries: &'static [Entry],
        bootloader: Device,
        started: Started,
        flash: FileFlash,
        layout: &'static Layout,
    ) -> Self {
        let device = Device { device_type: DEVICE_TYPE, software_version: SOFTWARE_VERSION, ..bootloader };
        Self { entries, device, started, flash, layout, leave: None }
    }

    /// Its object dictionary on a device with this many programs.
    #[must_use]
    pub fn entries(programs: u8) -> Vec<Entry> {
        let mut entries = device::ENTRIES.to_vec();
        for (name, element) in CONTROL_ARRAYS {
            let index = element.at.index;
            entries.push(Entry::array(index, name, programs));
            entries.extend((1..=programs).map(|sub| Entry { at: Address::new(index, sub), ..element }));
        }
        entries
    }

    /// The address of the device for layer setting services.
    #[must_use]
    pub fn lss_address(&self) -> LssAddress {
        self.device.lss_address()
    }

    /// Returns once how the device must leave, if it must.
    pub fn take_leave(&mut self) -> Option<Leave> {
        self.leave.take()
    }

    /// The flash of the device.
    pub fn flash(&mut self) -> &mut FileFlash {
        &mut self.flash
    }

    /// Ends the stand-in, and returns the flash.
    #[must_use]
    pub fn into_flash(self) -> FileFlash {
        self.flash
    }

    /// The record of a program.
    fn record(&self, program: u8) -> Option<ProgramRecord> {
        ProgramRecord::load(&Journal::open(&self.flash, self.layout.parameters), &self.flash, program)
    }

    /// The effect of the callgate's confirmation: the program is released, and needs no rescue
    /// window.
    fn confirm(&mut self, program: u8) -> Result<(), AbortCode> {
        let record = self.record(program).ok_or(AbortCode::HARDWARE)?;
        let mut journal = Journal::open(&self.flash, self.layout.parameters);
        let confirmed = ProgramRecord { signed: true, confirmed: true, ..record };
        journal.store(Key::Program(program), confirmed.value());
        run(&mut self.flash, |flash, outcome| journal.next(flash, outcome)).map_err(|_| AbortCode::HARDWARE)
    }

    /// 1F51h: a command.
    fn program_control(&mut self, program: u8, command: ProgramControl) -> Result<(), AbortCode> {
        let Started { program: own, fresh, bootloader_answers } = self.started;
        let standing = Standing { fresh, armed: false, can_hand_over: bootloader_answers.is_some() };
        self.leave = Some(match react(command, program == own, standing)? {
            Reaction::Nothing => return Ok(()),
            Reaction::Confirm => {
                self.started.fresh = false;
                return self.confirm(program);
            }
            Reaction::CallBack => Leave::Answered(BootRequest::Stay),
            Reaction::Restart => Leave::Answered(BootRequest::Start(program)),
            Reaction::HandOver => {
                let node_id = bootloader_answers.map_or(0, NodeId::get);
                Leave::Owed(Owed { program, value: command as u8, node_id })
            }
        });
        Ok(())
    }
}

impl Objects for StandIn {
    fn entries(&self) -> &'static [Entry] {
        self.entries
    }

    fn read(&mut self, at: Address, buf: &mut [u8]) -> Result<usize, AbortCode> {
        if let Some(read) = self.device.read(at, buf) {
            return read;
        }
        match at.index {
            PROGRAM_CONTROL => {
                let state = match self.record(at.sub) {
                    _ if at.sub == self.started.program => ProgramState::Running,
                    Some(_) => ProgramState::Stopped,
                    None => ProgramState::Absent,
                };
                put(buf, &[state as u8])
            }
            PROGRAM_ID => {
                let crc = self.record(at.sub).map_or(0, |record| record.crc);
                put(buf, &crc.to_le_bytes())
            }
            FLASH_STATUS => put(buf, &FlashStatus::OK.to_word().to_le_bytes()),
            PROGRAM_REGION => {
                let Region { base, size } = self.layout.program(at.sub).ok_or(AbortCode::NO_DATA)?;
                put(buf, &region_value(base, size))
            }
            PROGRAM_VERSION => {
                let version = self.record(at.sub).map_or(0, |record| record.version);
                put(buf, &version.to_le_bytes())
            }
            _ => Err(AbortCode::NO_DATA),
        }
    }

    fn write(&mut self, at: Address, data: &[u8]) -> Result<(), AbortCode> {
        let (PROGRAM_CONTROL, &[value]) = (at.index, data) else { return Err(AbortCode::UNSUPPORTED_ACCESS) };
        self.program_control(at.sub, ProgramControl::try_from(value)?)
    }
}

impl LssDevice for StandIn {
    fn supports(&mut self, rate: BitRate) -> bool {
        crate::supports(rate)
    }

    /// Only the bootloader stores.
    fn store(&mut self, _: Option<NodeId>, _: Option<BitRate>) -> Poll<Result<(), StoreError>> {
        Poll::Ready(Err(StoreError::Unsupported))
    }
}

impl SlaveDevice for StandIn {
    fn node_id_changed(&mut self, id: Option<NodeId>) {
        // The node-ID is not stored: the bootloader starts with the previous one.
        self.started.bootloader_answers = self.started.bootloader_answers.filter(|own| id == Some(*own));
    }
}
