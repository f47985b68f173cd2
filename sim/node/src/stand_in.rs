//! The replacement of a program: no CPU can run the program in the file. The stand-in answers the
//! requests that a host sends to a running application (CiA 302-3): which program runs (1F51h) and
//! its identification (1F56h). It accepts the commands of 1F51h like the application template.

use std::task::Poll;

use boot_core::canopen::device::{self, Device};
use boot_core::canopen::lss::{LssAddress, LssDevice, StoreError};
use boot_core::canopen::od::{put, Address, Entry, Objects, Reply};
use boot_core::canopen::program::{APPLICATION_STATE_ENTRIES, CONTROL_ARRAYS, DATE_ENTRIES, PROGRAM_CONTROL};
use boot_core::canopen::slave::SlaveDevice;
use boot_core::canopen::{AbortCode, BitRate, Instant, NodeId};
use boot_core::flash::run;
use boot_core::store::{Journal, Key, Parameters as _, ProgramRecord};
use coboot_app::callgate::{CallgateError, ProgramArgs, Status, PROGRAM_INSTALLED, PROGRAM_SIGNED};
use coboot_app::{Confirmed, ProgramControl, Services, Start};
use shared_abi::layout::Layout;

use crate::file_flash::FileFlash;

/// 1000h: no standardised profile, and not the bootloader's value.
const DEVICE_TYPE: u32 = 0;
/// 100Ah. It must not look like the program itself.
const SOFTWARE_VERSION: &str = "coboot-node stand-in";

/// The stand-in for a program.
#[derive(Debug)]
pub struct StandIn {
    entries: &'static [Entry],
    device: Device,
    /// 1F51h, 1F56h, 1F57h, and the way back.
    pub control: ProgramControl,
    /// It refuses each command to leave.
    pub refuses: bool,
    underneath: Underneath,
    /// The time that was set last.
    now: Instant,
}

/// What a program has of its bootloader, without one.
#[derive(Debug)]
struct Underneath {
    flash: FileFlash,
    /// The places of programs and journal.
    layout: &'static Layout,
}

impl Underneath {
    /// What is known of a program.
    fn record(&self, program: u8) -> Option<ProgramRecord> {
        Journal::open(&self.flash, self.layout.parameters).program(&self.flash, program)
    }
}

impl Services for Underneath {
    fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
        let record = self.record(number).ok_or(CallgateError::Refused(Status::NoProgram as i32))?;
        Ok(ProgramArgs {
            number: number.into(),
            size: record.size,
            crc: record.crc,
            version: record.version,
            flags: PROGRAM_INSTALLED | if record.signed { PROGRAM_SIGNED } else { 0 },
        })
    }

    /// What a program does through the callgate: it is signed, and needs no rescue window.
    fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError> {
        let record = self.record(number).ok_or(CallgateError::Refused(Status::NoProgram as i32))?;
        let mut journal = Journal::open(&self.flash, self.layout.parameters);
        let confirmed = ProgramRecord { signed: true, confirmed: true, ..record };
        journal.store(Key::program(number), confirmed.value());
        run(&mut self.flash, |flash, outcome| journal.next(flash, outcome))
            .map(|()| Confirmed::Now)
            .map_err(|_| CallgateError::Refused(Status::Failed as i32))
    }
}

impl StandIn {
    /// The stand-in for the program that was started so, on a device with this flash and this identity
    /// of the bootloader. `hands_over`: the bootloader comes up as the same node.
    #[must_use]
    pub fn new(
        entries: &'static [Entry],
        bootloader: Device,
        start: &Start,
        hands_over: bool,
        flash: FileFlash,
        layout: &'static Layout,
    ) -> Self {
        let device = Device { device_type: DEVICE_TYPE, software_version: SOFTWARE_VERSION, ..bootloader };
        let mut underneath = Underneath { flash, layout };
        let crc = underneath.program_info(start.program).map_or(0, |info| info.crc);
        let control = ProgramControl::new(start, layout, crc);
        let control = if hands_over { control } else { control.answering_itself() };
        Self { entries, device, control, refuses: false, underneath, now: Instant::from_millis(0) }
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
        entries.extend(APPLICATION_STATE_ENTRIES);
        entries.extend(DATE_ENTRIES);
        entries
    }

    /// The address of the device for layer setting services.
    #[must_use]
    pub fn lss_address(&self) -> LssAddress {
        self.device.lss_address()
    }

    /// Sets the time, before each frame.
    pub fn set_time(&mut self, now: Instant) {
        self.now = now;
    }

    /// The flash of the device.
    pub fn flash(&mut self) -> &mut FileFlash {
        &mut self.underneath.flash
    }

    /// Ends the stand-in, and returns the flash.
    #[must_use]
    pub fn into_flash(self) -> FileFlash {
        self.underneath.flash
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
        match self.control.read(at.index, at.sub, &mut self.underneath) {
            Some(value) => put(buf, &value?),
            None => Err(AbortCode::NO_DATA),
        }
    }

    fn write_with_reply(&mut self, at: Address, data: &[u8], expedited: bool) -> Result<Reply, AbortCode> {
        if at.index != PROGRAM_CONTROL {
            return Err(AbortCode::UNSUPPORTED_ACCESS);
        }
        if self.refuses {
            return Err(AbortCode::DEVICE_STATE);
        }
        let now = self.now.as_millis();
        Ok(self.control.write(at.sub, data, expedited, now, &mut self.underneath)?.into())
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
        self.control.node_id_changed(id.map(NodeId::get));
    }
}
