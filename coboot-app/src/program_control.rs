//! Objects 1F51h, 1F56h and 1F57h of an application (CiA 302-3), and those of coboot beside them, for
//! any CANopen stack.
//!
//! [`ProgramControl`] says what to answer, and when to leave. What the stack does with it:
//!
//! | request | call | answer |
//! |---|---|---|
//! | upload of one of the objects below | [`read`](ProgramControl::read) | the [`Value`] |
//! | download to 1F51h/n | [`write`](ProgramControl::write) | as [`Reply`] says |
//! | NMT reset node | [`nmt_reset`](ProgramControl::nmt_reset) | |
//!
//! On a device whose bootloader can be renewed over CAN, that has a sub-index, too: here it is a program that
//! does not run.
//!
//! After each frame, and every few milliseconds, [`proceed`](ProgramControl::proceed).

use shared_abi::callgate::{CallgateError, ProgramArgs, PROGRAM_INSTALLED, PROGRAM_SIGNED};
use shared_abi::handoff::SdoBases;
use shared_abi::layout::Layout;
use shared_abi::renewal::BOOTLOADER;
use shared_abi::warm_start::{BootRequest, Owed, StoredNode};

use crate::abort::Abort;
use crate::bootloader::{Bootloader, Confirmed, Services, LOCKED, NO_NODE_ID};
use crate::departure::{Departure, Next};
use crate::rules::{react, Command, Reaction, State};
use crate::start::Start;

/// 1F51h: program control.
pub const PROGRAM_CONTROL: u16 = 0x1F51;
/// 1F56h: program software identification.
pub const PROGRAM_ID: u16 = 0x1F56;
/// Verify application software (CiA 302-3): date and time of the program.
pub const PROGRAM_DATE: u16 = 0x1F52;
/// 1F57h: flash status identification.
pub const FLASH_STATUS: u16 = 0x1F57;
/// 2004h: where the flash of a program is, an object of coboot: address, then size.
pub const PROGRAM_REGION: u16 = 0x2004;
/// 2005h: the version of a program, an object of coboot: that of its record in the bootloader.
pub const PROGRAM_VERSION: u16 = 0x2005;
/// 2007h: device state, an object of coboot. An application has its sub-index 1 alone: the
/// sub-index of the bootloader itself; 0 if it cannot be renewed over CAN.
pub const DEVICE_STATE: u16 = 0x2007;

/// The value of 1F51h for a program that is installed and does not run.
const STOPPED: u8 = 0;
/// The value of 1F51h for the program that runs.
const RUNNING: u8 = 1;
/// The value of 1F51h where no program is installed.
const ABSENT: u8 = 3;

/// What an upload reads: 1 to 8 bytes, little-endian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Value {
    bytes: [u8; 8],
    len: u8,
}

impl Value {
    pub(crate) const fn byte(value: u8) -> Self {
        Self { bytes: (value as u64).to_le_bytes(), len: 1 }
    }

    #[cfg(feature = "responder")]
    pub(crate) const fn half(value: u16) -> Self {
        Self { bytes: (value as u64).to_le_bytes(), len: 2 }
    }

    pub(crate) const fn word(value: u32) -> Self {
        Self { bytes: (value as u64).to_le_bytes(), len: 4 }
    }
}

impl core::ops::Deref for Value {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.bytes[..usize::from(self.len)]
    }
}

/// What the SDO server does after a download to 1F51h that was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Reply {
    /// It confirms the download, as always.
    Send,
    /// It sends **nothing**, and nor does anything else of the device from now on: the bootloader
    /// confirms in this program's place.
    Withhold,
}

#[cfg(feature = "canopen")]
impl From<Reply> for canopen::od::Reply {
    fn from(reply: Reply) -> Self {
        match reply {
            Reply::Send => Self::Send,
            Reply::Withhold => Self::Withhold,
        }
    }
}

/// Program control of a running application.
#[derive(Clone, Debug)]
pub struct ProgramControl {
    /// The program that runs.
    program: u8,
    /// The places of the programs.
    layout: &'static Layout,
    /// The sub-index of the bootloader itself, if it can be renewed over CAN.
    bootloader: Option<u8>,
    /// 1F56h of the program that runs.
    crc: u32,
    /// The next 80h to this program confirms it.
    fresh: bool,
    /// The password of a lift came: 1F51h = 2 and NMT reset node lead into the bootloader.
    armed: bool,
    /// The request that a master was promised for the coming reset: the bootloader, or the
    /// confirmation of this program. No other master can replace it.
    promised: Option<BootRequest>,
    /// The rule of [`asking`](Self::asking).
    may_leave: fn() -> bool,
    /// The application has refused a master since its start: an NMT reset leaves with this request.
    refused: Option<BootRequest>,
    /// Node-ID in force.
    node_id: Option<u8>,
    /// The node-ID with which the bootloader can answer in this program's place.
    bootloader_node: Option<u8>,
    sdo: SdoBases,
    /// The two elements of 1F52h.
    software_date: [u32; 2],
    departure: Departure<BootRequest>,
}

impl ProgramControl {
    /// Of a program that came up so, on a device with this memory map. `crc` is what 1F56h reads for
    /// this program (`Bootloader::program_crc`).
    #[must_use]
    pub const fn new(start: &Start, layout: &'static Layout, crc: u32) -> Self {
        Self {
            program: start.program,
            layout,
            bootloader: start.bootloader_number(),
            crc,
            fresh: start.fresh,
            armed: false,
            promised: None,
            may_leave: || true,
            refused: None,
            node_id: start.node_id,
            bootloader_node: start.bootloader_node(),
            sdo: start.sdo(),
            software_date: start.software_date(),
            departure: Departure::Staying,
        }
    }

    /// For a device whose bootloader has another node-ID than this program (126 on a lift), or
    /// whose SDO server cannot withhold a confirmation: the application answers STOP itself and
    /// refuses CLEAR.
    #[must_use]
    pub const fn answering_itself(self) -> Self {
        Self { bootloader_node: None, ..self }
    }

    /// With the application's rule about leaving, which is asked once before a command of 1F51h, or
    /// a request of the application itself, ends in a reset. It answers at once. No: the command is
    /// refused (08000022h), and the program stays. Yes is final: the reset follows, 500 ms later at
    /// most, and what stands must not start to move while [`leaving`](Self::leaving). An NMT reset
    /// does not ask.
    ///
    /// So that an application which refuses for ever does not lock itself in, its first refusal of
    /// a master takes back that it is confirmed: the next start has the rescue window. That writes
    /// flash as [`Bootloader::store_node`] does. For a sealed program nothing is stored; it has the
    /// window after an NMT reset.
    #[must_use]
    pub const fn asking(self, may_leave: fn() -> bool) -> Self {
        Self { may_leave, ..self }
    }

    /// Whether the device is about to leave, until the reset of the chip.
    #[must_use]
    pub fn leaving(&self) -> bool {
        self.departure != Departure::Staying
    }

    /// The bases of the COB-IDs of SDO.
    #[must_use]
    pub const fn sdo(&self) -> SdoBases {
        self.sdo
    }

    /// The program that runs, 1 to 254.
    #[must_use]
    pub const fn program(&self) -> u8 {
        self.program
    }

    /// What an upload reads of 1F51h, 1F52h, 1F56h, 1F57h, 2004h, 2005h and 2007h; `None` for any
    /// other object. To an application, the bootloader is a program that does not run.
    pub fn read(&self, index: u16, sub: u8, services: &mut impl Services) -> Option<Result<Value, Abort>> {
        let highest = match index {
            DEVICE_STATE => 1,
            PROGRAM_DATE => 2,
            PROGRAM_CONTROL | PROGRAM_ID | FLASH_STATUS | PROGRAM_REGION | PROGRAM_VERSION => {
                self.bootloader.unwrap_or(self.programs())
            }
            _ => return None,
        };
        Some(match (index, sub) {
            (_, 0) => Ok(Value::byte(highest)),
            (DEVICE_STATE, 1) => Ok(Value::byte(self.bootloader.unwrap_or(0))),
            (PROGRAM_DATE, 1 | 2) => Ok(Value::word(self.software_date[usize::from(sub) - 1])),
            (DEVICE_STATE | PROGRAM_DATE, _) => Err(Abort::NO_SUB_INDEX),
            (_, sub) => self.check(sub).map(|()| self.of_program(index, sub, services)),
        })
    }

    /// One of the objects that each program has.
    fn of_program(&self, index: u16, sub: u8, services: &mut impl Services) -> Value {
        let is_bootloader = Some(sub) == self.bootloader;
        let mut info = || services.program_info(if is_bootloader { BOOTLOADER } else { sub });
        match index {
            PROGRAM_CONTROL if sub == self.program => Value::byte(RUNNING),
            PROGRAM_CONTROL => {
                let is_there = info().is_ok_and(|info| info.flags & PROGRAM_INSTALLED != 0);
                Value::byte(if is_there { STOPPED } else { ABSENT })
            }
            PROGRAM_ID if sub == self.program => Value::word(self.crc),
            PROGRAM_ID => Value::word(info().map_or(0, |info| info.crc)),
            PROGRAM_REGION => {
                let region = if is_bootloader { self.layout.home } else { self.layout.program(sub) };
                let [base, size] = region.map_or([0; 2], |region| [region.base, region.size]);
                Value { bytes: (u64::from(size) << 32 | u64::from(base)).to_le_bytes(), len: 8 }
            }
            PROGRAM_VERSION => Value::word(info().map_or(0, |info| info.version)),
            // 1F57h: no command is being carried out, and none has failed.
            _ => Value::word(0),
        }
    }

    /// The number of programs of the device.
    const fn programs(&self) -> u8 {
        self.layout.programs.len() as u8
    }

    /// The device has this node-ID from now on; `None` for none.
    pub fn node_id_changed(&mut self, node_id: Option<u8>) {
        self.node_id = node_id;
    }

    /// The bootloader has stored this node-ID ([`Bootloader::store_node`](crate::Bootloader)),
    /// together with the bit rate in force (`same_bit_rate`) or another one. It uses them from now
    /// on.
    pub fn node_stored(&mut self, node_id: Option<u8>, same_bit_rate: bool) {
        if self.bootloader_node.is_some() {
            self.bootloader_node = if same_bit_rate { node_id } else { None };
        }
    }

    /// The password of a lift came (6005h, CiA 814-1 clause 6.3): 1F51h = 2 and NMT reset node lead
    /// into the bootloader.
    pub fn arm(&mut self) {
        self.armed = true;
    }

    /// Handles a download of `data` to 1F51h/`sub`. Call it before the SDO answer is sent.
    ///
    /// `expedited`: the client wrote it by an expedited download, whose confirmation the bootloader
    /// can send as well. That of a segment or block is this program's alone, so it answers STOP
    /// itself and refuses CLEAR.
    ///
    /// # Errors
    /// The code of the SDO abort to answer with; nothing was changed.
    pub fn write(
        &mut self,
        sub: u8,
        data: &[u8],
        expedited: bool,
        now: u32,
        services: &mut impl Services,
    ) -> Result<Reply, Abort> {
        if sub == 0 {
            return Err(Abort::READ_ONLY);
        }
        self.check(sub)?;
        let value = match data {
            [value] => *value,
            [] => return Err(Abort::LENGTH_TOO_LOW),
            _ => return Err(Abort::LENGTH_TOO_HIGH),
        };
        let command = Command::from_value(value).ok_or(Abort::INVALID_VALUE)?;
        if command == Command::Stop && Some(sub) == self.bootloader {
            // It does not run.
            return Ok(Reply::Send);
        }
        let answers = self.bootloader_node.filter(|node| expedited && self.node_id == Some(*node));
        let Self { fresh, armed, .. } = *self;
        let state = State { fresh, armed, can_hand_over: answers.is_some() };
        let reaction = react(command, sub == self.program, state)?;
        let leaves = matches!(reaction, Reaction::CallBack | Reaction::Restart | Reaction::HandOver);
        if leaves && !self.permits() {
            return Err(self.refuse(services));
        }
        match reaction {
            Reaction::Nothing => {}
            Reaction::Confirm => match self.confirm(now, services) {
                Err(Abort::DEVICE_STATE) if !self.leaving() => return Err(self.refuse(services)),
                confirmed => confirmed?,
            },
            Reaction::CallBack => {
                let request = match (self.promised, command) {
                    (Some(before @ BootRequest::Owed(_)), _) => before,
                    // The answer comes from here, so the bootloader owes none to a node; it counts STOP.
                    (None | Some(BootRequest::Stay), Command::Stop) => {
                        BootRequest::Owed(Owed { program: sub, value, node_id: 0 })
                    }
                    _ => BootRequest::Stay,
                };
                self.promise(request, now)?;
            }
            _ if matches!(self.promised, Some(BootRequest::Confirm(_) | BootRequest::StoreNode(_))) => {
                return Err(Abort::DEVICE_STATE)
            }
            Reaction::Restart => self.leave(BootRequest::Start(sub), now),
            Reaction::HandOver => {
                let node_id = answers.unwrap_or(0);
                self.departure.begin_silent(BootRequest::Owed(Owed { program: sub, value, node_id }), now);
                return Ok(Reply::Withhold);
            }
        }
        Ok(Reply::Send)
    }

    /// This program is good: it has heard its master, say, or a master has said so. Where the flash
    /// is locked (a sealed program) the device restarts to store it, if it [may
    /// leave](Self::asking). Writes flash ([`Bootloader::store_node`] says how long that takes). A
    /// program that has refused to leave since its start is released by this, and keeps its rescue
    /// window.
    ///
    /// # Errors
    /// [`Abort::HARDWARE`] where the bootloader did not store it, or there is none;
    /// [`Abort::DEVICE_STATE`] where the device may not leave now, or leaves for another reason.
    pub fn confirm(&mut self, now: u32, services: &mut impl Services) -> Result<(), Abort> {
        let is_released = |info: ProgramArgs| info.flags & PROGRAM_SIGNED != 0;
        let keeps_window = self.refused == Some(BootRequest::Rescue);
        if keeps_window && services.program_info(self.program).is_ok_and(is_released) {
            self.fresh = false;
            return Ok(());
        }
        let confirmed = services.confirm(self.program);
        // Until it is stored, an 80h that comes again means the same.
        self.fresh &= confirmed == Ok(Confirmed::AtReset);
        match confirmed {
            Ok(Confirmed::Now) if keeps_window => {
                services.unconfirm(self.program).map_err(|_| Abort::HARDWARE)
            }
            Ok(Confirmed::Now) => Ok(()),
            Ok(Confirmed::AtReset) => self.restart_with(BootRequest::Confirm(self.program), now),
            Err(_) => Err(Abort::HARDWARE),
        }
    }

    /// [`Bootloader::store_node`] for values that the application itself decides on. Where the
    /// flash is locked (a sealed program) the device restarts to store them, if it [may
    /// leave](Self::asking).
    ///
    /// # Errors
    /// As for [`confirm`](Self::confirm).
    pub fn store_node(
        &mut self,
        node_id: Option<u8>,
        bit_rate: u32,
        now: u32,
        bootloader: &Bootloader,
    ) -> Result<(), Abort> {
        let node = StoredNode::new(node_id.unwrap_or(NO_NODE_ID), bit_rate);
        match bootloader.store_node(node_id, bit_rate) {
            Err(CallgateError::Refused(LOCKED)) => self.restart_with(BootRequest::StoreNode(node), now),
            stored => stored.map_err(|_| Abort::HARDWARE),
        }
    }

    /// The application itself wants to restart, as after a power-on.
    ///
    /// # Errors
    /// [`Abort::DEVICE_STATE`] where it [may not leave](Self::asking) now.
    pub fn restart(&mut self, now: u32) -> Result<(), Abort> {
        self.permits().then(|| self.nmt_reset(now)).ok_or(Abort::DEVICE_STATE)
    }

    /// An NMT reset node command came, which is not refused (CiA 301). The device restarts as after
    /// a power-on, so that the bootloader counts no crash. A lift that has its password goes into
    /// the bootloader.
    pub fn nmt_reset(&mut self, now: u32) {
        let request = self.refused.unwrap_or(BootRequest::PowerOn);
        self.leave(if self.armed { BootRequest::Stay } else { request }, now);
    }

    /// Advances the departure. `bus_idle`: no answer waits to be sent, and all frames are on the
    /// bus and were acknowledged. Call it after every frame and every few milliseconds.
    pub fn proceed(&mut self, bus_idle: bool, now: u32) -> Next<BootRequest> {
        self.departure.proceed(bus_idle, now)
    }

    /// The answer of the application. A device that is leaving is not asked again.
    fn permits(&self) -> bool {
        self.leaving() || (self.may_leave)()
    }

    /// The refusal of a master. The next start has the rescue window. That is stored once since the
    /// start: whoever asks for ever wears nothing out.
    fn refuse(&mut self, services: &mut impl Services) -> Abort {
        if self.refused != Some(BootRequest::Rescue) {
            let known = services.unconfirm(self.program);
            // A bootloader without this service would take the request for a crash.
            let is_known = matches!(known, Ok(()) | Err(CallgateError::Refused(LOCKED)));
            self.refused = Some(if is_known { BootRequest::Rescue } else { BootRequest::PowerOn });
        }
        Abort::DEVICE_STATE
    }

    /// The device restarts to store something, if the application permits it.
    fn restart_with(&mut self, request: BootRequest, now: u32) -> Result<(), Abort> {
        if !self.permits() {
            return Err(Abort::DEVICE_STATE);
        }
        self.promise(request, now)
    }

    /// The device leaves with this request, unless it was promised to leave with another one.
    fn promise(&mut self, request: BootRequest, now: u32) -> Result<(), Abort> {
        // An answered STOP leads into the bootloader, too.
        let keeps = |promised| {
            promised == request || promised == BootRequest::Stay && matches!(request, BootRequest::Owed(_))
        };
        if !self.promised.is_none_or(keeps) {
            return Err(Abort::DEVICE_STATE);
        }
        self.promised = Some(request);
        self.leave(request, now);
        Ok(())
    }

    fn leave(&mut self, request: BootRequest, now: u32) {
        let promised = !matches!(request, BootRequest::PowerOn | BootRequest::Rescue | BootRequest::Start(_));
        self.departure.begin(request, promised, now);
    }

    fn check(&self, sub: u8) -> Result<(), Abort> {
        if (1..=self.programs()).contains(&sub) || Some(sub) == self.bootloader {
            Ok(())
        } else {
            Err(Abort::NO_SUB_INDEX)
        }
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::Region;
    use shared_abi::handoff::{BootInfo, ResetCause};

    use super::*;
    use crate::start::Defaults;

    const DEFAULTS: Defaults = Defaults { node_id: Some(32), bit_rate: 125_000, serial_number: 0 };
    const STATE: Abort = Abort(0x0800_0022);

    /// A bootloader that knows program 2, with what its callgate says to a confirmation.
    struct Fake {
        confirm: Result<Confirmed, CallgateError>,
        confirmed: usize,
        /// What it says when the confirmation is taken back, and how often that came.
        unconfirm: Result<(), CallgateError>,
        unconfirmed: usize,
    }

    const STORES: Fake =
        Fake { confirm: Ok(Confirmed::Now), confirmed: 0, unconfirm: Ok(()), unconfirmed: 0 };
    /// That of a sealed program: the flash is locked.
    const LOCKS: Fake =
        Fake { confirm: Ok(Confirmed::AtReset), unconfirm: Err(CallgateError::Refused(-8)), ..STORES };

    impl Services for Fake {
        fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
            match number {
                1 if self.confirmed > 0 => Ok(ProgramArgs { flags: 3, ..ProgramArgs::default() }),
                2 => Ok(ProgramArgs { crc: 0x1122_3344, version: 7, flags: 1, ..ProgramArgs::default() }),
                _ => Err(CallgateError::Refused(-7)),
            }
        }

        fn confirm(&mut self, number: u8) -> Result<Confirmed, CallgateError> {
            assert_eq!(number, 1);
            self.confirmed += usize::from(self.confirm != Ok(Confirmed::AtReset));
            self.confirm
        }

        fn unconfirm(&mut self, number: u8) -> Result<(), CallgateError> {
            assert_eq!(number, 1);
            self.unconfirmed += 1;
            self.unconfirm
        }
    }

    /// A start by a bootloader with this number.
    fn boot_info(bootloader_number: u8) -> BootInfo {
        BootInfo {
            node_id: 5,
            bit_rate: 125_000,
            program: 1,
            reset_cause: ResetCause::PowerOn,
            trial: false,
            fresh: false,
            bootloader_version: 0,
            serial_number: 0,
            bootloader_number: Some(bootloader_number),
            sdo: SdoBases::PREDEFINED,
            program_date: 1_795_804_215,
            nameplate: false,
        }
    }

    /// A memory map with so many programs.
    fn layout(programs: usize) -> &'static Layout {
        const PROGRAMS: [Region; 3] = [Region::new(0x0802_0000, 0x2_0000); 3];
        const fn with(programs: &'static [Region]) -> Layout {
            Layout { programs, ..shared_abi::layout::stm32f407g_disc1::LAYOUT }
        }
        static LAYOUTS: [Layout; 3] =
            [with(PROGRAMS.split_at(1).0), with(PROGRAMS.split_at(2).0), with(&PROGRAMS)];
        &LAYOUTS[programs - 1]
    }

    /// Program 1 of three.
    fn control(fresh: bool) -> ProgramControl {
        ProgramControl::new(&Start { fresh, ..Start::new(None, DEFAULTS) }, layout(3), 0xCAFE)
    }

    /// What an upload reads, as a number.
    fn read(
        control: &ProgramControl,
        index: u16,
        sub: u8,
        services: &mut impl Services,
    ) -> Result<u64, Abort> {
        let value = control.read(index, sub, services).unwrap()?;
        Ok(value.iter().rev().fold(0, |number, byte| number << 8 | u64::from(*byte)))
    }

    fn request_behind(control: &mut ProgramControl) -> Next<BootRequest> {
        control.proceed(true, 100);
        control.proceed(true, 200)
    }

    #[test]
    fn each_object_tells_of_every_program() {
        let control = control(false);
        let none = Err(Abort(0x0609_0011));
        let region = Ok(0x0002_0000_0802_0000);
        for (index, values) in [
            (0x1F51, [Ok(3), Ok(1), Ok(0), Ok(3), none]),
            (0x1F56, [Ok(3), Ok(0xCAFE), Ok(0x1122_3344), Ok(0), none]),
            (0x1F57, [Ok(3), Ok(0), Ok(0), Ok(0), none]),
            (0x2004, [Ok(3), region, region, region, none]),
            (0x2005, [Ok(3), Ok(0), Ok(7), Ok(0), none]),
            // Nobody has told a date, nor the number of the bootloader.
            (0x1F52, [Ok(2), Ok(0), Ok(0), none, none]),
            (0x2007, [Ok(1), Ok(0), none, none, none]),
        ] {
            let read: [_; 5] = core::array::from_fn(|sub| read(&control, index, sub as u8, &mut { STORES }));
            assert_eq!(read, values, "{index:04X}h");
        }
        assert!(control.read(0x1018, 1, &mut { STORES }).is_none());
    }

    /// The number of the bootloader follows those of the programs, with a gap on a lift (CiA 814-1 gives
    /// number 2 to the parameters). To the application the bootloader is a program that does not run.
    #[test]
    fn the_bootloader_has_a_number_where_it_can_be_renewed() {
        struct Renewable;
        impl Services for Renewable {
            fn program_info(&mut self, number: u8) -> Result<ProgramArgs, CallgateError> {
                assert_eq!(number, 255, "the number that the callgate has for the bootloader");
                Ok(ProgramArgs { crc: 0x0B00_710A, version: 7, flags: 1, ..ProgramArgs::default() })
            }

            fn confirm(&mut self, _: u8) -> Result<Confirmed, CallgateError> {
                Err(CallgateError::Absent)
            }
        }
        let none = Abort(0x0609_0011);
        for (programs, number) in [(1, 2), (1, 3), (2, 3)] {
            let start = Start { fresh: true, ..Start::new(Some(boot_info(number)), DEFAULTS) };
            let mut control = ProgramControl::new(&start, layout(programs.into()), 0xCAFE);
            for (index, sub, value) in [
                (0x2007, 1, u64::from(number)),
                (0x1F51, 0, number.into()),
                (0x1F51, number, 0),
                (0x1F56, number, 0x0B00_710A),
                (0x1F57, number, 0),
                (0x2005, number, 7),
                (0x1F52, 1, 15_671),
                (0x1F52, 2, 66_615_000),
            ] {
                assert_eq!(read(&control, index, sub, &mut Renewable), Ok(value), "{index:04X}h/{sub}");
            }
            let home = read(&control, 0x2004, number, &mut Renewable).unwrap();
            assert_eq!(home as u32, 0x0801_0000);
            for absent in (programs + 1..number).chain([number + 1, 255]) {
                assert_eq!(read(&control, 0x1F51, absent, &mut Renewable), Err(none), "{absent}");
            }
            // What is the bootloader's to do, it does.
            for value in [1, 2, 0x83, 0x84] {
                assert_eq!(control.write(number, &[value], true, 0, &mut Renewable), Err(STATE), "{value}");
            }
            assert_eq!(
                control.write(number, &[0], true, 0, &mut Renewable),
                Ok(Reply::Send),
                "it is stopped"
            );
            assert_eq!(request_behind(&mut control), Next::Serve);
            let mut cleared = control.clone();
            assert_eq!(cleared.write(number, &[3], true, 0, &mut Renewable), Ok(Reply::Withhold));
            let owed = Owed { program: number, value: 3, node_id: 5 };
            assert_eq!(request_behind(&mut cleared), Next::Leave(BootRequest::Owed(owed)));
            // It confirms no program: that is another sub-index.
            assert_eq!(control.write(number, &[0x80], true, 0, &mut Renewable), Ok(Reply::Send));
            assert_eq!(request_behind(&mut control), Next::Leave(BootRequest::Stay));
        }
    }

    #[test]
    fn what_is_no_command_is_refused_and_nothing_happens() {
        let mut control = control(true);
        for (sub, data, code) in [
            (0, &[0x80][..], 0x0601_0002),
            (4, &[0x80], 0x0609_0011),
            (255, &[0x80], 0x0609_0011),
            (1, &[], 0x0607_0013),
            (1, &[0x80, 0], 0x0607_0012),
            (1, &[4], 0x0609_0030),
            (1, &[0xFF], 0x0609_0030),
            (1, &[0x83], 0x0800_0022),
            (2, &[1], 0x0800_0022),
        ] {
            let mut services = STORES;
            assert_eq!(control.write(sub, data, true, 0, &mut services), Err(Abort(code)), "{sub} {data:X?}");
            assert_eq!(services.confirmed, 0);
            assert_eq!(request_behind(&mut control), Next::Serve);
        }
    }

    #[test]
    fn stop_and_clear_are_left_to_the_bootloader() {
        for (value, sub) in [(0, 1), (3, 2)] {
            let mut control = control(false);
            let owed = Owed { program: sub, value, node_id: 32 };
            assert_eq!(control.write(sub, &[value], true, 0, &mut { STORES }), Ok(Reply::Withhold));
            assert_eq!(control.proceed(false, 0), Next::Wait);
            assert_eq!(control.proceed(true, 1), Next::Leave(BootRequest::Owed(owed)));
        }
    }

    /// Where the answer cannot be withheld, and where the bootloader comes up as another node.
    #[test]
    fn a_bootloader_that_cannot_answer_is_not_asked_to() {
        let mut in_segments = control(false);
        assert_eq!(in_segments.write(1, &[3], false, 0, &mut { STORES }), Err(STATE));
        assert_eq!(in_segments.write(1, &[0], false, 0, &mut { STORES }), Ok(Reply::Send));
        let stopped = BootRequest::Owed(Owed { program: 1, value: 0, node_id: 0 });
        assert_eq!(request_behind(&mut in_segments), Next::Leave(stopped));
        let mut changed = control(false);
        changed.node_id_changed(Some(33));
        let mut stored = control(false);
        stored.node_stored(Some(32), false);
        for mut control in [changed.clone(), stored, control(false).answering_itself()] {
            assert_eq!(control.write(1, &[3], true, 0, &mut { STORES }), Err(STATE));
            // Before it or after it, 80h makes no difference to the STOP.
            for value in [0x80, 0, 0x80] {
                assert_eq!(
                    control.write(1, &[value], true, 0, &mut { STORES }),
                    Ok(Reply::Send),
                    "it leaves"
                );
            }
            assert_eq!(request_behind(&mut control), Next::Leave(stopped));
        }
        // Stored, the new node-ID is the bootloader's as well.
        changed.node_stored(Some(33), true);
        let owed = Owed { program: 1, value: 3, node_id: 33 };
        assert_eq!(changed.write(1, &[3], true, 0, &mut { STORES }), Ok(Reply::Withhold));
        assert_eq!(request_behind(&mut changed), Next::Leave(BootRequest::Owed(owed)));
    }

    #[test]
    fn the_first_80h_to_a_fresh_program_confirms_it_and_the_second_calls_the_bootloader() {
        let mut control = control(true);
        let mut services = STORES;
        assert_eq!(control.write(1, &[0x80], true, 0, &mut services), Ok(Reply::Send));
        assert_eq!(services.confirmed, 1);
        assert_eq!(request_behind(&mut control), Next::Serve);
        assert_eq!(control.write(1, &[0x80], true, 300, &mut services), Ok(Reply::Send));
        assert_eq!((services.confirmed, control.proceed(true, 900)), (1, Next::Leave(BootRequest::Stay)));
    }

    #[test]
    fn a_confirmation_that_fails_is_told_and_the_next_80h_calls_the_bootloader() {
        let mut control = control(true);
        let mut fails = Fake { confirm: Err(CallgateError::Absent), ..STORES };
        assert_eq!(control.write(1, &[0x80], true, 0, &mut fails), Err(Abort(0x0606_0000)));
        assert_eq!(request_behind(&mut control), Next::Serve);
        assert_eq!(control.write(1, &[0x80], true, 300, &mut fails), Ok(Reply::Send));
        assert_eq!(control.proceed(true, 900), Next::Leave(BootRequest::Stay));
    }

    /// In front of a sealed program the flash is locked: once the confirmation is acknowledged,
    /// no other command takes it back.
    #[test]
    fn a_confirmation_at_the_reset_is_kept_against_other_commands() {
        let mut control = control(true);
        let mut locked = LOCKS;
        assert_eq!(control.write(1, &[0x80], true, 0, &mut locked), Ok(Reply::Send));
        assert_eq!(control.write(1, &[0x80], true, 1, &mut locked), Ok(Reply::Send), "the same again");
        for value in [0, 2, 3] {
            assert_eq!(control.write(1, &[value], true, 2, &mut locked), Err(STATE), "{value}");
        }
        control.nmt_reset(3);
        assert_eq!(request_behind(&mut control), Next::Leave(BootRequest::Confirm(1)));
        // Nor the node-ID that the application was told to be stored.
        let stored = BootRequest::StoreNode(StoredNode::new(5, 125_000));
        let mut stores = self::control(false);
        assert_eq!(stores.promise(stored, 0), Ok(()));
        for value in [0, 2, 3, 0x80] {
            assert_eq!(stores.write(1, &[value], true, 2, &mut { LOCKS }), Err(STATE), "{value}");
        }
        assert_eq!(request_behind(&mut stores), Next::Leave(stored));
    }

    /// Nothing has happened after a no, and nothing is owed, however often a master asks; an NMT
    /// reset is not refused (CiA 301). A bootloader that is older than the rescue request would
    /// count a crash.
    #[test]
    fn an_application_that_may_not_leave_stays_and_gets_the_rescue_window() {
        let refused = |code| Err(CallgateError::Refused(code));
        for (answer, times, request) in [
            (Ok(()), 1, BootRequest::Rescue),
            (refused(-8), 1, BootRequest::Rescue),
            (refused(-1), 1000, BootRequest::PowerOn),
            (Err(CallgateError::Absent), 1000, BootRequest::PowerOn),
        ] {
            for (sub, value) in [(1, 0x80), (2, 0x80), (1, 0), (2, 0), (1, 2), (1, 3), (2, 3)] {
                let mut control = control(false).asking(|| false);
                let mut services = Fake { unconfirm: answer, ..STORES };
                for _ in 0..1000 {
                    assert_eq!(control.write(sub, &[value], true, 0, &mut services), Err(STATE), "{value}");
                }
                assert_eq!((control.leaving(), services.unconfirmed), (false, times), "{value} {answer:?}");
                assert_eq!(request_behind(&mut control), Next::Serve);
                control.nmt_reset(0);
                assert!(control.leaving());
                assert_eq!(request_behind(&mut control), Next::Leave(request), "{answer:?}");
            }
        }
        // What the application itself wants locks nobody out.
        let (mut sealed, mut locks) = (control(true).asking(|| false), LOCKS);
        assert_eq!((sealed.confirm(0, &mut locks), sealed.restart(0)), (Err(STATE), Err(STATE)));
        assert_eq!((sealed.refused, locks.unconfirmed), (None, 0));
        assert_eq!(sealed.write(1, &[0x80], true, 0, &mut locks), Err(STATE), "it needs a reset");
        assert_eq!((request_behind(&mut sealed), locks.unconfirmed), (Next::Serve, 1));
        sealed.may_leave = || true;
        assert_eq!(sealed.write(1, &[0x80], true, 0, &mut locks), Ok(Reply::Send), "it still confirms");
        assert_eq!(request_behind(&mut sealed), Next::Leave(BootRequest::Confirm(1)));
        // A confirmation after the refusal releases the program, and the window stays.
        let (mut fresh, mut services) = (control(true).asking(|| false), STORES);
        assert_eq!(fresh.write(1, &[2], true, 0, &mut services), Err(STATE));
        for _ in 0..1000 {
            assert_eq!(fresh.confirm(0, &mut services), Ok(()));
        }
        assert_eq!((services.confirmed, services.unconfirmed), (1, 2));
    }

    /// It is asked once, and not for a CLEAR in segments, which is refused before that.
    #[test]
    fn a_yes_is_final() {
        for (value, expedited) in
            [0x80, 0, 2, 3].into_iter().flat_map(|value| [(value, true), (value, false)])
        {
            let is_refused = value == 3 && !expedited;
            let says: fn() -> bool = if is_refused { || panic!("it was asked") } else { || true };
            let mut control = control(false).asking(says);
            let taken = control.write(1, &[value], expedited, 0, &mut { STORES });
            assert_eq!((taken.is_ok(), control.leaving()), (!is_refused, !is_refused), "{value} {expedited}");
            if is_refused {
                continue;
            }
            control.may_leave = || panic!("it was asked again");
            assert!(control.write(1, &[0x80], true, 5, &mut { STORES }).is_ok());
            assert!(matches!(request_behind(&mut control), Next::Leave(_)) && control.leaving());
        }
    }

    #[test]
    fn a_restart_counts_as_no_crash_and_an_armed_lift_goes_to_the_bootloader() {
        let mut control_of_lift = control(false).answering_itself();
        control_of_lift.arm();
        control_of_lift.nmt_reset(0);
        assert_eq!(request_behind(&mut control_of_lift), Next::Leave(BootRequest::Stay));
        let mut plain = control(false);
        assert_eq!(plain.restart(0), Ok(()));
        assert_eq!(request_behind(&mut plain), Next::Leave(BootRequest::PowerOn));
        let mut again = control(false);
        assert_eq!(again.write(1, &[2], true, 0, &mut { STORES }), Ok(Reply::Send));
        assert_eq!(request_behind(&mut again), Next::Leave(BootRequest::Start(1)));
    }

    /// A place without a program may have a record: only the flag says that one is installed.
    #[test]
    fn a_program_that_is_not_installed_is_absent() {
        struct NotInstalled(u32);
        impl Services for NotInstalled {
            fn program_info(&mut self, _: u8) -> Result<ProgramArgs, CallgateError> {
                Ok(ProgramArgs { flags: self.0, ..ProgramArgs::default() })
            }

            fn confirm(&mut self, _: u8) -> Result<Confirmed, CallgateError> {
                Err(CallgateError::Absent)
            }
        }
        let control = control(false);
        let second = Start { program: 2, ..Start::new(None, DEFAULTS) };
        assert_eq!((control.program(), ProgramControl::new(&second, layout(3), 0).program()), (1, 2));
        for (flags, state) in [(0, 3), (2, 3), (0xFFFF_FFFE, 3), (1, 0), (3, 0)] {
            assert_eq!(read(&control, 0x1F51, 2, &mut NotInstalled(flags)), Ok(state), "{flags:#x}");
        }
    }
}
