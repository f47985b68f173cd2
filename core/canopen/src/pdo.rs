//! Process data objects and SYNC of a device (CiA 301 sections 7.2.2 and 7.2.5).
//!
//! A device keeps [`Pdos`] beside its other values, and calls them from its [`Objects`] and its
//! [`Exchange`](crate::od::Exchange). Its process is an [`Objects`] of its own: what this one's table
//! has may be mapped, into a TPDO if it can be read, into an RPDO if it can be written.
//!
//! The event of the transmission types 0, 254 and 255 is that a mapped value is another one; 254 and
//! 255 also send when the node becomes OPERATIONAL. There are no remote frames (types 252 and 253),
//! identifiers of 29 bits, dummy entries, nor a counter or window of SYNC.

use core::array;
use core::cmp::Ordering;
use core::mem;

use embedded_can::Frame as _;

use crate::abort::AbortCode;
use crate::emcy::code;
use crate::frame::{CobId, Frame, NodeId};
use crate::nmt::NmtState;
use crate::od::{self, put, Access, Address, DataType, Entry, Objects, Table};
use crate::time::Instant;

/// COB-ID of SYNC.
pub const COB_ID_SYNC: u16 = 0x1005;
/// Communication parameter of the first RPDO; that of the others follow.
pub const RPDO_COMMUNICATION: u16 = 0x1400;
/// Mapping parameter of the first RPDO.
pub const RPDO_MAPPING: u16 = 0x1600;
/// Communication parameter of the first TPDO.
pub const TPDO_COMMUNICATION: u16 = 0x1800;
/// Mapping parameter of the first TPDO.
pub const TPDO_MAPPING: u16 = 0x1A00;

/// The most objects in a PDO: each has a byte at least.
pub const MAPPED: usize = 8;
/// Event-driven, by an event of the manufacturer's.
pub const EVENT_DRIVEN: u8 = 254;

/// In the word of a COB-ID: the PDO does not exist.
const INVALID: u32 = 1 << 31;
/// In the word of a TPDO's COB-ID: no remote frame asks for it.
const NO_RTR: u32 = 1 << 30;
/// The pre-defined COB-ID of SYNC.
const SYNC: CobId = CobId::new(0x080).unwrap();
/// The PDOs with a COB-ID in the pre-defined connection set.
const PREDEFINED: usize = 4;

/// A PDO as the device comes up with it: with the COB-ID of the pre-defined connection set, and from
/// the fifth on without one.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Transmission type: 0 to 240 by SYNC, 254 and 255 by events.
    pub transmission: u8,
    /// Of a TPDO: at least so many times 100 µs are between two events; 0 for no limit.
    pub inhibit: u16,
    /// Of a TPDO: it is sent again after so many ms without an event; 0 for never.
    pub event_ms: u16,
    /// What it carries, from the table of the process: eight bytes at most.
    pub mapping: &'static [Entry],
}

impl Preset {
    /// The word of 1600h/n, counted from 0; 0 for none.
    const fn word(&self, n: usize) -> u32 {
        if n < self.mapping.len() {
            let Entry { at, .. } = &self.mapping[n];
            (at.index as u32) << 16 | (at.sub as u32) << 8 | bits(&self.mapping[n])
        } else {
            0
        }
    }
}

/// The bits of a value in a PDO; of a text more than a PDO has.
const fn bits(entry: &Entry) -> u32 {
    match entry.data_type.size() {
        Some(bytes) => 8 * bytes,
        None => u8::MAX as u32,
    }
}

/// The number of entries that [`Table::with_pdos`] appends.
#[must_use]
pub const fn entry_count(receive: &[Preset], transmit: &[Preset]) -> usize {
    1 + (3 + 1 + MAPPED) * receive.len() + (5 + 1 + MAPPED) * transmit.len()
}

impl<const LEN: usize> Table<LEN> {
    /// Appends 1005h and the parameters of these PDOs, [`entry_count`] entries.
    ///
    /// # Panics
    /// If the table has too few entries left, or a PDO has more than eight bytes.
    #[must_use]
    pub const fn with_pdos(self, receive: &[Preset], transmit: &[Preset]) -> Self {
        const RECEIVE: [&str; PREDEFINED] =
            ["$NODEID+0x200", "$NODEID+0x300", "$NODEID+0x400", "$NODEID+0x500"];
        const TRANSMIT: [&str; PREDEFINED] =
            ["$NODEID+0x40000180", "$NODEID+0x40000280", "$NODEID+0x40000380", "$NODEID+0x40000480"];
        let sync = Entry::var(COB_ID_SYNC, "COB-ID SYNC message", DataType::Unsigned32, Access::Rw);
        let mut table = self.with(&[sync.default(SYNC.get() as u64)]);
        let mut n = 0;
        while n < receive.len() {
            let index = RPDO_COMMUNICATION + n as u16;
            table = table
                .with(&[Entry::record(index, "RPDO communication parameter", 2)])
                .with(&communication(index, &receive[n], n, &RECEIVE, 0))
                .with_mapping(RPDO_MAPPING + n as u16, "RPDO mapping parameter", &receive[n]);
            n += 1;
        }
        let mut n = 0;
        while n < transmit.len() {
            let (index, preset) = (TPDO_COMMUNICATION + n as u16, &transmit[n]);
            let times = [
                Entry::sub(index, 3, "Inhibit time", DataType::Unsigned16, Access::Rw)
                    .default(preset.inhibit as u64),
                Entry::sub(index, 5, "Event timer", DataType::Unsigned16, Access::Rw)
                    .default(preset.event_ms as u64),
            ];
            table = table
                .with(&[Entry::record(index, "TPDO communication parameter", 5)])
                .with(&communication(index, preset, n, &TRANSMIT, NO_RTR))
                .with(&times)
                .with_mapping(TPDO_MAPPING + n as u16, "TPDO mapping parameter", preset);
            n += 1;
        }
        table
    }

    const fn with_mapping(self, index: u16, name: &'static str, preset: &Preset) -> Self {
        const NAMES: [&str; MAPPED] = [
            "Application object 1",
            "Application object 2",
            "Application object 3",
            "Application object 4",
            "Application object 5",
            "Application object 6",
            "Application object 7",
            "Application object 8",
        ];
        let count = preset.mapping.len();
        let head = Entry::record(index, name, MAPPED as u8).access(Access::Rw).default(count as u64);
        let mut table = self.with(&[head]);
        let (mut n, mut length) = (0, 0);
        while n < MAPPED {
            let word = preset.word(n);
            length += word & 0xFF;
            let object = Entry::sub(index, n as u8 + 1, NAMES[n], DataType::Unsigned32, Access::Rw);
            table = table.with(&[object.default(word as u64)]);
            n += 1;
        }
        assert!(count <= MAPPED && length <= 64, "pdo: a PDO has more than eight bytes");
        table
    }
}

/// Sub-indices 1 and 2 of a communication parameter.
const fn communication(
    index: u16,
    preset: &Preset,
    number: usize,
    cob_ids: &[&'static str; PREDEFINED],
    flags: u32,
) -> [Entry; 2] {
    let cob_id = Entry::sub(index, 1, "COB-ID used by PDO", DataType::Unsigned32, Access::Rw);
    [
        if number < PREDEFINED {
            cob_id.default_text(cob_ids[number])
        } else {
            cob_id.default((INVALID | flags) as u64)
        },
        Entry::sub(index, 2, "Transmission type", DataType::Unsigned8, Access::Rw)
            .default(preset.transmission as u64),
    ]
}

/// Whether no object with a configurable COB-ID may have this one (CiA 301 table 40).
const fn is_restricted(id: u32) -> bool {
    matches!(id, 0..=0x07F | 0x101..=0x180 | 0x581..=0x5FF | 0x601..=0x67F | 0x6E0..)
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Direction {
    Receive,
    Transmit,
}

/// A value of the parameters of a PDO.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Parameter {
    CobId,
    TransmissionType,
    InhibitTime,
    EventTimer,
    /// The number of mapped objects: sub-index 0 of the mapping.
    Count,
    /// A mapped object, counted from 0.
    Object(usize),
}

/// What a PDO has done since it exists as it is now.
#[derive(Clone, Copy, Debug, Default)]
struct Progress {
    /// Of an RPDO, until SYNC; of a TPDO, since SYNC.
    waiting: Option<Frame>,
    /// The last one sent, and when.
    sent: Option<Frame>,
    sent_at: Instant,
    /// SYNCs since the last one sent.
    syncs: u8,
    /// The emergency about the frame before.
    fault: Option<u16>,
}

#[derive(Clone, Copy, Debug)]
struct Pdo {
    direction: Direction,
    /// 11 bits, and [`INVALID`].
    cob_id: u32,
    transmission: u8,
    inhibit: u16,
    event_ms: u16,
    count: u8,
    objects: [u32; MAPPED],
    progress: Progress,
}

impl Pdo {
    fn all<const N: usize>(
        direction: Direction,
        presets: &'static [Preset; N],
        id: Option<NodeId>,
    ) -> [Self; N] {
        let base = match direction {
            Direction::Receive => 0x200,
            Direction::Transmit => 0x180,
        };
        array::from_fn(|number| {
            let preset = &presets[number];
            let id = id.filter(|_| number < PREDEFINED);
            Self {
                direction,
                cob_id: id.map_or(INVALID, |id| base + 0x100 * number as u32 + u32::from(id.get())),
                transmission: preset.transmission,
                inhibit: preset.inhibit,
                event_ms: preset.event_ms,
                count: preset.mapping.len() as u8,
                objects: array::from_fn(|n| preset.word(n)),
                progress: Progress::default(),
            }
        })
    }

    /// Its COB-ID, if it exists.
    fn id(&self) -> Option<CobId> {
        CobId::new(u16::try_from(self.cob_id).ok()?)
    }

    fn is_synchronous(&self) -> bool {
        self.transmission <= 240
    }

    fn mapped(&self) -> &[u32] {
        self.objects.get(..usize::from(self.count)).unwrap_or_default()
    }

    /// An RPDO has arrived. Returns the emergency for a wrong length, once until it is another one.
    fn take(&mut self, frame: &Frame, process: &mut impl Objects) -> Option<u16> {
        let length: u32 = self.mapped().iter().map(|word| word & 0xFF).sum();
        if length == 0 {
            return None;
        }
        let fault = match frame.data().len().cmp(&(length as usize / 8)) {
            Ordering::Less => Some(code::PDO_LENGTH),
            Ordering::Equal => None,
            Ordering::Greater => Some(code::PDO_LENGTH_EXCEEDED),
        };
        match fault {
            Some(code::PDO_LENGTH) => {}
            _ if self.is_synchronous() => self.progress.waiting = Some(*frame),
            _ => self.deliver(frame, process),
        }
        (mem::replace(&mut self.progress.fault, fault) != fault).then_some(fault).flatten()
    }

    /// Writes what an RPDO carries. Nobody is told of a value that the process refuses: a PDO has no
    /// answer.
    fn deliver(&self, frame: &Frame, process: &mut impl Objects) {
        let mut rest = frame.data();
        for word in self.mapped() {
            let Some((value, behind)) = rest.split_at_checked((word & 0xFF) as usize / 8) else { return };
            let _ = process.write(address(*word), value);
            rest = behind;
        }
    }

    /// A TPDO with the present values, if it exists and has any.
    fn compose(&self, process: &mut impl Objects) -> Option<Frame> {
        let (mut data, mut len) = ([0; 8], 0);
        for word in self.mapped() {
            len += process.read(address(*word), &mut data[len..]).ok()?;
        }
        let id = self.id()?;
        (len > 0).then(|| Frame::of(id, &data[..len]))
    }

    /// SYNC has come: a TPDO takes its values now.
    fn sample(&mut self, process: &mut impl Objects) {
        self.progress.syncs = self.progress.syncs.saturating_add(1);
        if !self.is_synchronous() || self.progress.syncs < self.transmission {
            return;
        }
        let sent = self.progress.sent.filter(|_| self.transmission == 0);
        self.progress.waiting = self.compose(process).filter(|frame| Some(*frame) != sent);
        self.progress.syncs = 0;
    }

    /// The TPDO, if it is to be sent now.
    fn next(&mut self, now: Instant, process: &mut impl Objects) -> Option<Frame> {
        let frame = match self.progress.waiting.take() {
            Some(frame) => frame,
            None if self.is_synchronous() => return None,
            None => {
                let frame = self.compose(process)?;
                let since = now.since(self.progress.sent_at);
                // One more: the millisecond in which it was sent may have been almost over.
                let inhibit = self.inhibit.div_ceil(10) + u16::from(self.inhibit > 0);
                let is_due = self.progress.sent.is_none_or(|sent| {
                    let is_again = self.event_ms > 0 && since >= u32::from(self.event_ms);
                    since >= u32::from(inhibit) && (sent != frame || is_again)
                });
                is_due.then_some(frame)?
            }
        };
        self.progress.sent = Some(frame);
        self.progress.sent_at = now;
        Some(frame)
    }

    /// The value of a parameter, and how many bytes it has.
    fn get(&self, parameter: Parameter) -> (u32, usize) {
        match parameter {
            Parameter::CobId if self.direction == Direction::Transmit => (self.cob_id | NO_RTR, 4),
            Parameter::CobId => (self.cob_id, 4),
            Parameter::TransmissionType => (self.transmission.into(), 1),
            Parameter::InhibitTime => (self.inhibit.into(), 2),
            Parameter::EventTimer => (self.event_ms.into(), 2),
            Parameter::Count => (self.count.into(), 1),
            Parameter::Object(n) => (self.objects[n], 4),
        }
    }

    /// Sets a parameter. What exists keeps its COB-ID, its inhibit time and its mapping: it is made
    /// invalid first, and to change objects their number is set to 0.
    fn set(
        &mut self,
        parameter: Parameter,
        value: u32,
        dictionary: &[Entry],
        process: &impl Objects,
    ) -> Result<(), AbortCode> {
        // The present value again changes nothing.
        if self.get(parameter).0 == value {
            return Ok(());
        }
        let exists = self.id().is_some();
        let require = |good: bool, code: AbortCode| if good { Ok(()) } else { Err(code) };
        match parameter {
            Parameter::CobId => {
                // A TPDO reads as one without remote frames, whatever a master writes there.
                let id = value & !(INVALID | NO_RTR);
                let will_exist = value & INVALID == 0;
                let stays = !exists || !will_exist || id == self.cob_id;
                let is_good = id <= 0x7FF && stays && !(will_exist && is_restricted(id));
                require(is_good, AbortCode::INVALID_VALUE)?;
                self.cob_id = id | value & INVALID;
            }
            Parameter::TransmissionType => {
                require(matches!(value, 0..=240 | 254 | 255), AbortCode::INVALID_VALUE)?;
                self.transmission = value as u8;
            }
            Parameter::InhibitTime => {
                require(!exists, AbortCode::INVALID_VALUE)?;
                self.inhibit = value as u16;
            }
            Parameter::EventTimer => {
                self.event_ms = value as u16;
                return Ok(());
            }
            Parameter::Count => {
                require(!exists, AbortCode::PARAMETER)?;
                let mapped = self.objects.get(..value as usize).ok_or(AbortCode::PDO_LENGTH)?;
                require(!mapped.contains(&0), AbortCode::PARAMETER)?;
                let length: u32 = mapped.iter().map(|word| word & 0xFF).sum();
                require(length <= 64, AbortCode::PDO_LENGTH)?;
                self.count = value as u8;
            }
            Parameter::Object(n) => {
                require(!exists && self.count == 0, AbortCode::PARAMETER)?;
                require(value == 0 || self.maps(value, dictionary, process)?, AbortCode::NOT_MAPPABLE)?;
                self.objects[n] = value;
            }
        }
        self.progress = Progress::default();
        Ok(())
    }

    /// Whether this PDO can carry the object. An error if the device does not have it.
    fn maps(&self, word: u32, dictionary: &[Entry], process: &impl Objects) -> Result<bool, AbortCode> {
        let entry = od::find(dictionary, address(word))?;
        let is_accessible = match self.direction {
            Direction::Receive => entry.access.is_writable(),
            Direction::Transmit => entry.access.is_readable(),
        };
        let is_process = od::find(process.entries(), entry.at).is_ok();
        Ok(is_process && is_accessible && bits(entry) == word & 0xFF)
    }
}

/// Where a mapped object is.
const fn address(word: u32) -> Address {
    Address::new((word >> 16) as u16, (word >> 8) as u8)
}

/// SYNC, and the PDOs of a device: `R` RPDOs and `T` TPDOs.
#[derive(Clone, Debug)]
pub struct Pdos<const R: usize, const T: usize> {
    presets: (&'static [Preset; R], &'static [Preset; T]),
    sync: CobId,
    /// The last SYNC had data.
    sync_has_data: bool,
    receive: [Pdo; R],
    transmit: [Pdo; T],
    is_operational: bool,
    identifiers_changed: bool,
}

impl<const R: usize, const T: usize> Pdos<R, T> {
    /// Without a node-ID yet: no PDO exists.
    #[must_use]
    pub fn new(receive: &'static [Preset; R], transmit: &'static [Preset; T]) -> Self {
        Self {
            presets: (receive, transmit),
            sync: SYNC,
            sync_has_data: false,
            receive: Pdo::all(Direction::Receive, receive, None),
            transmit: Pdo::all(Direction::Transmit, transmit, None),
            is_operational: false,
            identifiers_changed: false,
        }
    }

    /// The communication is reset: all parameters are those of a power-on, with this node-ID.
    pub fn reset(&mut self, id: Option<NodeId>) {
        *self = Self::new(self.presets.0, self.presets.1);
        self.receive = Pdo::all(Direction::Receive, self.presets.0, id);
        self.transmit = Pdo::all(Direction::Transmit, self.presets.1, id);
    }

    /// The COB-IDs of SYNC and of the RPDOs that exist.
    pub fn identifiers(&self) -> impl Iterator<Item = CobId> + '_ {
        core::iter::once(self.sync).chain(self.receive.iter().filter_map(Pdo::id))
    }

    /// Whether [`identifiers`](Self::identifiers) were changed since the last call.
    pub fn identifiers_changed(&mut self) -> bool {
        mem::take(&mut self.identifiers_changed)
    }

    /// The NMT state is this one now: PDOs are exchanged in OPERATIONAL alone.
    pub fn state_changed(&mut self, state: NmtState) {
        let was_operational = mem::replace(&mut self.is_operational, state == NmtState::Operational);
        if !was_operational {
            self.receive
                .iter_mut()
                .chain(&mut self.transmit)
                .for_each(|pdo| pdo.progress = Progress::default());
        }
    }

    /// Processes any received frame. Returns the code of an emergency: an RPDO that is too short, and
    /// has no effect (8210h), an RPDO (8220h) or SYNC (8240h) that is too long.
    pub fn handle(&mut self, frame: &Frame, process: &mut impl Objects) -> Option<u16> {
        let id = frame.cob_id().filter(|_| self.is_operational)?;
        if id == self.sync {
            return self.synchronise(!frame.data().is_empty(), process);
        }
        let of_id = self.receive.iter_mut().filter(|pdo| pdo.id() == Some(id));
        of_id.fold(None, |fault, pdo| pdo.take(frame, process).or(fault))
    }

    fn synchronise(&mut self, has_data: bool, process: &mut impl Objects) -> Option<u16> {
        for pdo in &mut self.receive {
            if let Some(frame) = pdo.progress.waiting.take() {
                pdo.deliver(&frame, process);
            }
        }
        self.transmit.iter_mut().for_each(|pdo| pdo.sample(process));
        let had_data = mem::replace(&mut self.sync_has_data, has_data);
        (has_data && !had_data).then_some(code::SYNC_LENGTH)
    }

    /// The next TPDO to send; `None` if none is due.
    pub fn poll(&mut self, now: Instant, process: &mut impl Objects) -> Option<Frame> {
        let mut transmit = self.transmit.iter_mut().filter(|_| self.is_operational);
        transmit.find_map(|pdo| pdo.next(now, process))
    }

    /// Reads a parameter; `None` for every other address.
    ///
    /// # Errors
    /// [`AbortCode::OUT_OF_MEMORY`] if it does not fit.
    pub fn read(&mut self, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        if at == Address::new(COB_ID_SYNC, 0) {
            return Some(put(buf, &u32::from(self.sync.get()).to_le_bytes()));
        }
        let (pdo, parameter) = self.find(at)?;
        let (value, len) = pdo.get(parameter);
        Some(put(buf, &value.to_le_bytes()[..len]))
    }

    /// Writes a parameter; `None` for every other address. `dictionary` is that of the device, with the
    /// objects that it does not map.
    ///
    /// # Errors
    /// [`AbortCode::INVALID_VALUE`] for a value that the parameter cannot have, or not while the PDO
    /// exists. Of a mapping: [`AbortCode::NO_OBJECT`], [`AbortCode::NO_SUB_INDEX`] and
    /// [`AbortCode::NOT_MAPPABLE`] for the object, [`AbortCode::PDO_LENGTH`] for more than eight objects
    /// or bytes, [`AbortCode::PARAMETER`] in another order than that of CiA 301 clause 7.5.2.36: make the
    /// PDO invalid, set the number to 0, the objects, the number, make it valid.
    pub fn write(
        &mut self,
        at: Address,
        data: &[u8],
        dictionary: &[Entry],
        process: &impl Objects,
    ) -> Option<Result<(), AbortCode>> {
        let value = data.iter().rfold(0, |value, byte| value << 8 | u32::from(*byte));
        if at == Address::new(COB_ID_SYNC, 0) {
            // Bit 31 has no meaning; bit 30 would make it the producer.
            let id = u16::try_from(value & !INVALID).ok().and_then(CobId::new);
            let id = id.filter(|id| !is_restricted(id.get().into()));
            let Some(id) = id else { return Some(Err(AbortCode::INVALID_VALUE)) };
            self.sync = id;
        } else {
            let (pdo, parameter) = self.find(at)?;
            if let Err(code) = pdo.set(parameter, value, dictionary, process) {
                return Some(Err(code));
            }
        }
        self.identifiers_changed = true;
        Some(Ok(()))
    }

    /// The PDO with a parameter at this address.
    fn find(&mut self, at: Address) -> Option<(&mut Pdo, Parameter)> {
        let number = usize::from(at.index & 0x1FF);
        let first = at.index & !0x1FF;
        let pdo = match first {
            RPDO_COMMUNICATION | RPDO_MAPPING => self.receive.get_mut(number),
            TPDO_COMMUNICATION | TPDO_MAPPING => self.transmit.get_mut(number),
            _ => None,
        };
        let parameter = match (first, at.sub) {
            (RPDO_MAPPING | TPDO_MAPPING, 0) => Parameter::Count,
            (RPDO_MAPPING | TPDO_MAPPING, sub @ 1..=8) => Parameter::Object(usize::from(sub) - 1),
            (_, 1) => Parameter::CobId,
            (_, 2) => Parameter::TransmissionType,
            (TPDO_COMMUNICATION, 3) => Parameter::InhibitTime,
            (TPDO_COMMUNICATION, 5) => Parameter::EventTimer,
            _ => return None,
        };
        pdo.map(|pdo| (pdo, parameter))
    }
}
