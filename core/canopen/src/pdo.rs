//! Process data objects and SYNC of a device (CiA 301 sections 7.2.2 and 7.2.5).
//!
//! A device keeps [`Pdos`] beside its other values, and calls them from its [`Objects`] and its
//! [`Exchange`](crate::od::Exchange). Its process is an [`Objects`] of its own: what this one's
//! table has may be mapped, into a TPDO if it can be read, into an RPDO if it can be written.
//!
//! The event of the transmission types 0, 254 and 255 is that a mapped value is another one. Not
//! here: remote frames (types 252, 253), 29 bits, dummy entries, a counter or window of SYNC.

use core::{array, mem};

use embedded_can::Frame as _;

use crate::abort::AbortCode;
use crate::emcy::code;
use crate::frame::{CobId, Frame, NodeId};
use crate::nmt::NmtState;
use crate::od::{find, put, Access, Address, DataType, Entry, Objects, Table};
use crate::time::Instant;

/// COB-ID of SYNC.
const SYNC: Address = Address::new(0x1005, 0);
/// In the word of a COB-ID: the PDO does not exist.
const INVALID: u32 = 1 << 31;
/// In the word of a TPDO's COB-ID: no remote frame asks for it.
const NO_RTR: u32 = 1 << 30;
/// The most objects in a PDO: each has a byte at least.
const MAPPED: usize = 8;
/// The entries of an RPDO; a TPDO has two more.
const ENTRIES: usize = 3 + 1 + MAPPED;

/// A PDO as the device comes up with it.
#[derive(Clone, Copy, Debug)]
pub struct Preset {
    /// Index of its communication parameter: 1400h to 1403h for an RPDO, 1800h to 1803h for a TPDO.
    pub index: u16,
    /// Transmission type: 0 to 240 by SYNC, 254 and 255 by events.
    pub transmission: u8,
    /// Of a TPDO: so many times 100 µs are between two events at least; 0 for no limit.
    pub inhibit: u16,
    /// Of a TPDO: it is sent again after so many ms without an event; 0 for never.
    pub event_ms: u16,
    /// What it carries, from the table of the process: eight bytes at most.
    pub mapping: &'static [Entry],
}

impl Preset {
    const fn is_transmit(&self) -> bool {
        self.index >= 0x1800
    }

    /// The mapped object with this sub-index; 0 for none.
    const fn object(&self, sub: usize) -> u32 {
        if sub > self.mapping.len() {
            return 0;
        }
        let entry = &self.mapping[sub - 1];
        (entry.at.index as u32) << 16 | (entry.at.sub as u32) << 8 | bits(entry)
    }
}

/// The bits of a value in a PDO; of a text more than a PDO has.
const fn bits(entry: &Entry) -> u32 {
    match entry.data_type.size() {
        Some(bytes) => 8 * bytes,
        None => 0xFF,
    }
}

/// How many entries [`Table::with_pdos`] appends.
#[must_use]
pub const fn entry_count(presets: &[Preset]) -> usize {
    let (mut n, mut count) = (0, 1);
    while n < presets.len() {
        count += ENTRIES + if presets[n].is_transmit() { 2 } else { 0 };
        n += 1;
    }
    count
}

impl<const LEN: usize> Table<LEN> {
    /// Appends 1005h and the parameters of these PDOs, [`entry_count`] entries.
    ///
    /// # Panics
    /// If the table has too few entries left, or a PDO is none.
    #[must_use]
    pub const fn with_pdos(self, presets: &[Preset]) -> Self {
        const COB_IDS: [[&str; 4]; 2] = [
            ["$NODEID+0x200", "$NODEID+0x300", "$NODEID+0x400", "$NODEID+0x500"],
            ["$NODEID+0x40000180", "$NODEID+0x40000280", "$NODEID+0x40000380", "$NODEID+0x40000480"],
        ];
        let sync = Entry::var(SYNC.index, "COB-ID SYNC message", DataType::Unsigned32, Access::Rw);
        let mut table = self.with(&[sync.default(0x80)]);
        let mut n = 0;
        while n < presets.len() {
            let (preset, index) = (&presets[n], presets[n].index);
            let cob_id = COB_IDS[preset.is_transmit() as usize][(index & 0x1FF) as usize];
            table = table.with(&[
                Entry::record(index, "PDO communication parameter", if preset.is_transmit() { 5 } else { 2 }),
                Entry::sub(index, 1, "COB-ID used by PDO", DataType::Unsigned32, Access::Rw)
                    .default_text(cob_id),
                Entry::sub(index, 2, "Transmission type", DataType::Unsigned8, Access::Rw)
                    .default(preset.transmission as u64),
            ]);
            if preset.is_transmit() {
                let inhibit = Entry::sub(index, 3, "Inhibit time", DataType::Unsigned16, Access::Rw);
                let event = Entry::sub(index, 5, "Event timer", DataType::Unsigned16, Access::Rw);
                table = table
                    .with(&[inhibit.default(preset.inhibit as u64), event.default(preset.event_ms as u64)]);
            }
            let head = Entry::record(index + 0x200, "PDO mapping parameter", MAPPED as u8).access(Access::Rw);
            table = table.with(&[head.default(preset.mapping.len() as u64)]);
            let (mut sub, mut length) = (1, 0);
            while sub <= MAPPED {
                let object = preset.object(sub);
                let entry =
                    Entry::sub(index + 0x200, sub as u8, "Mapped object", DataType::Unsigned32, Access::Rw);
                table = table.with(&[entry.default(object as u64)]);
                length += object & 0xFF;
                sub += 1;
            }
            assert!(preset.mapping.len() <= MAPPED && length <= 64, "pdo: more than eight bytes");
            n += 1;
        }
        table
    }
}

/// Whether no object with a configurable COB-ID may have this one (CiA 301 table 40).
const fn is_restricted(id: u32) -> bool {
    matches!(id, 0..=0x07F | 0x101..=0x180 | 0x581..=0x5FF | 0x601..=0x67F | 0x6E0..)
}

/// Where a mapped object is.
const fn address(object: u32) -> Address {
    Address::new((object >> 16) as u16, (object >> 8) as u8)
}

/// What a PDO has done since its parameters are these.
#[derive(Clone, Copy, Debug, Default)]
struct Progress {
    /// Of an RPDO, until SYNC; of a TPDO, since SYNC.
    waiting: Option<Frame>,
    /// The TPDO sent last, and when.
    sent: Option<Frame>,
    sent_at: Instant,
    /// SYNCs since then.
    syncs: u32,
    /// The emergency for the length of the last RPDO.
    fault: Option<u16>,
}

#[derive(Clone, Copy, Debug)]
struct Pdo {
    /// Index of its communication parameter.
    index: u16,
    /// By sub-index: 1 COB-ID, 2 transmission type, 3 inhibit time, 5 event timer.
    communication: [u32; 6],
    /// By sub-index: 0 how many, then the objects.
    mapping: [u32; MAPPED + 1],
    progress: Progress,
}

impl Pdo {
    fn new(preset: &Preset, id: Option<NodeId>) -> Self {
        let Preset { index, transmission, inhibit, event_ms, mapping } = *preset;
        let (base, flags) = if preset.is_transmit() { (0x180, NO_RTR) } else { (0x200, 0) };
        let base = base + u32::from(index & 0x1FF) * 0x100;
        let cob_id = flags | id.map_or(INVALID, |id| base + u32::from(id.get()));
        Self {
            index,
            communication: [0, cob_id, transmission.into(), inhibit.into(), 0, event_ms.into()],
            mapping: array::from_fn(|sub| if sub > 0 { preset.object(sub) } else { mapping.len() as u32 }),
            progress: Progress::default(),
        }
    }

    fn is_transmit(&self) -> bool {
        self.index >= 0x1800
    }

    /// Its COB-ID, if it exists.
    fn id(&self) -> Option<CobId> {
        CobId::new(u16::try_from(self.communication[1] & !NO_RTR).ok()?)
    }

    /// Its transmission type, if that is by SYNC.
    fn cycle(&self) -> Option<u32> {
        Some(self.communication[2]).filter(|cycle| *cycle <= 240)
    }

    fn mapped(&self) -> &[u32] {
        self.mapping.get(1..=self.mapping[0] as usize).unwrap_or_default()
    }

    /// An RPDO has arrived. Returns the emergency for its length, once until it has another one.
    fn take(&mut self, frame: &Frame, process: &mut impl Objects) -> Option<u16> {
        let length = self.mapped().iter().map(|object| (object & 0xFF) as usize).sum::<usize>() / 8;
        if length == 0 {
            return None;
        }
        let fault = match frame.data().len() {
            len if len < length => Some(code::PDO_LENGTH),
            len if len > length => Some(code::PDO_LENGTH_EXCEEDED),
            _ => None,
        };
        if fault != Some(code::PDO_LENGTH) {
            match self.cycle() {
                Some(_) => self.progress.waiting = Some(*frame),
                None => self.deliver(frame, process),
            }
        }
        (mem::replace(&mut self.progress.fault, fault) != fault).then_some(fault).flatten()
    }

    /// Writes what an RPDO carries. A value that the process refuses is not reported, and the next one is
    /// written all the same.
    fn deliver(&self, frame: &Frame, process: &mut impl Objects) {
        let mut rest = frame.data();
        for object in self.mapped() {
            let Some((value, others)) = rest.split_at_checked((object & 0xFF) as usize / 8) else { return };
            let _ = process.write(address(*object), value);
            rest = others;
        }
    }

    /// A TPDO with the present values, if it exists and has any.
    fn compose(&self, process: &mut impl Objects) -> Option<Frame> {
        let (mut data, mut len) = ([0; 8], 0);
        for object in self.mapped() {
            len += process.read(address(*object), &mut data[len..]).ok()?;
        }
        self.id().filter(|_| len > 0).map(|id| Frame::of(id, &data[..len]))
    }

    /// SYNC has come: an RPDO takes effect now, a TPDO takes its values now.
    fn synchronise(&mut self, process: &mut impl Objects) {
        let Some(cycle) = self.cycle() else { return };
        let waiting = self.progress.waiting.take();
        if !self.is_transmit() {
            waiting.iter().for_each(|frame| self.deliver(frame, process));
            return;
        }
        self.progress.syncs += 1;
        if self.progress.syncs >= cycle {
            let sent = self.progress.sent.filter(|_| cycle == 0);
            self.progress.waiting = self.compose(process).filter(|frame| Some(*frame) != sent);
            self.progress.syncs = 0;
        }
    }

    /// The TPDO, if it is to be sent now.
    fn next(&mut self, now: Instant, process: &mut impl Objects) -> Option<Frame> {
        let frame = match self.cycle() {
            Some(_) => self.progress.waiting.take()?,
            None => {
                let [.., inhibit, _, event_ms] = self.communication;
                let since = now.since(self.progress.sent_at);
                // One more: the millisecond in which it was sent may have been almost over.
                let may = inhibit == 0 || since > inhibit.div_ceil(10);
                let is_again = event_ms > 0 && since >= event_ms;
                let frame = self.compose(process)?;
                let is_due = |sent| may && (is_again || sent != frame);
                self.progress.sent.is_none_or(is_due).then_some(frame)?
            }
        };
        self.progress.sent = Some(frame);
        self.progress.sent_at = now;
        Some(frame)
    }

    /// A parameter, and how many bytes it has.
    fn parameter(&mut self, at: Address) -> Option<(&mut u32, usize)> {
        let sub = usize::from(at.sub);
        if at.index == self.index {
            let len = *[0, 4, 1, 2, 0, 2].get(sub).filter(|len| **len > 0)?;
            Some((&mut self.communication[sub], len))
        } else {
            Some((self.mapping.get_mut(sub)?, if sub == 0 { 1 } else { 4 }))
        }
    }

    /// Whether a parameter may have this value now, and the abort code if not. What exists keeps
    /// its COB-ID, inhibit time and mapping; what is counted in the mapping keeps its objects.
    fn check(
        &self,
        at: Address,
        value: u32,
        dictionary: &[Entry],
        process: &impl Objects,
    ) -> Result<(), AbortCode> {
        let (exists, will_exist) = (self.id().is_some(), value & INVALID == 0);
        let (is_good, code) = match (at.index == self.index, at.sub) {
            (true, 1) => {
                let id = value & !(INVALID | NO_RTR);
                let stays = self.id().is_none_or(|own| u32::from(own.get()) == id) || !will_exist;
                (id <= 0x7FF && stays && !(will_exist && is_restricted(id)), AbortCode::INVALID_VALUE)
            }
            (true, 2) => (matches!(value, 0..=240 | 254 | 255), AbortCode::INVALID_VALUE),
            (true, sub) => (!exists || sub != 3, AbortCode::INVALID_VALUE),
            (false, 0) => {
                let mapped = self.mapping.get(1..=value as usize).ok_or(AbortCode::PDO_LENGTH)?;
                if mapped.iter().map(|object| object & 0xFF).sum::<u32>() > 64 {
                    return Err(AbortCode::PDO_LENGTH);
                }
                (!exists && !mapped.contains(&0), AbortCode::PARAMETER)
            }
            (false, _) if exists || self.mapping[0] > 0 => (false, AbortCode::PARAMETER),
            (false, _) if value == 0 => (true, AbortCode::NOT_MAPPABLE),
            (false, _) => {
                let entry = find(dictionary, address(value))?;
                let access = entry.access;
                let may = if self.is_transmit() { access.is_readable() } else { access.is_writable() };
                let is_process = find(process.entries(), entry.at).is_ok();
                (may && is_process && bits(entry) == value & 0xFF, AbortCode::NOT_MAPPABLE)
            }
        };
        is_good.then_some(()).ok_or(code)
    }
}

/// SYNC, and the `N` PDOs of a device.
#[derive(Clone, Debug)]
pub struct Pdos<const N: usize> {
    sync: CobId,
    /// The last SYNC had data.
    sync_has_data: bool,
    pdos: [Pdo; N],
    is_operational: bool,
    identifiers_changed: bool,
}

impl<const N: usize> Pdos<N> {
    /// All is as after a reset of communication with this node-ID; without one, no PDO exists.
    #[must_use]
    pub fn new(presets: &[Preset; N], id: Option<NodeId>) -> Self {
        Self {
            sync: const { CobId::new(0x080).unwrap() },
            sync_has_data: false,
            pdos: array::from_fn(|n| Pdo::new(&presets[n], id)),
            is_operational: false,
            identifiers_changed: false,
        }
    }

    /// The COB-IDs of SYNC and of the RPDOs that exist.
    pub fn identifiers(&self) -> impl Iterator<Item = CobId> + '_ {
        let receive = self.pdos.iter().filter(|pdo| !pdo.is_transmit());
        core::iter::once(self.sync).chain(receive.filter_map(Pdo::id))
    }

    /// Whether [`identifiers`](Self::identifiers) may be others than at the last call.
    pub fn identifiers_changed(&mut self) -> bool {
        mem::take(&mut self.identifiers_changed)
    }

    /// The NMT state is this one now. A TPDO with an event is sent when it becomes OPERATIONAL.
    pub fn state_changed(&mut self, state: NmtState) {
        if !mem::replace(&mut self.is_operational, state == NmtState::Operational) {
            self.pdos.iter_mut().for_each(|pdo| pdo.progress = Progress::default());
        }
    }

    /// Processes any received frame. Returns the code of an emergency: an RPDO is too short and has
    /// no effect (8210h), an RPDO (8220h) or SYNC (8240h) is too long.
    pub fn handle(&mut self, frame: &Frame, process: &mut impl Objects) -> Option<u16> {
        let id = frame.cob_id().filter(|_| self.is_operational)?;
        if id == self.sync {
            self.pdos.iter_mut().for_each(|pdo| pdo.synchronise(process));
            let has_data = !frame.data().is_empty();
            let is_new = mem::replace(&mut self.sync_has_data, has_data) != has_data;
            return (has_data && is_new).then_some(code::SYNC_LENGTH);
        }
        let of_id = self.pdos.iter_mut().filter(|pdo| !pdo.is_transmit() && pdo.id() == Some(id));
        of_id.fold(None, |fault, pdo| pdo.take(frame, process).or(fault))
    }

    /// The next TPDO to send; `None` if none is due.
    pub fn poll(&mut self, now: Instant, process: &mut impl Objects) -> Option<Frame> {
        let mut transmit = self.pdos.iter_mut().filter(|pdo| self.is_operational && pdo.is_transmit());
        transmit.find_map(|pdo| pdo.next(now, process))
    }

    /// Reads a parameter; `None` for every other address.
    ///
    /// # Errors
    /// [`AbortCode::OUT_OF_MEMORY`] if it does not fit.
    pub fn read(&mut self, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        if at == SYNC {
            return Some(put(buf, &u32::from(self.sync.get()).to_le_bytes()));
        }
        let (value, len) = self.find(at)?.parameter(at)?;
        Some(put(buf, &value.to_le_bytes()[..len]))
    }

    /// Writes a parameter; `None` for every other address. `dictionary` has all objects of the
    /// device.
    ///
    /// # Errors
    /// [`AbortCode::INVALID_VALUE`] for a value that the parameter cannot have, or not while the
    /// PDO exists. Of a mapping: what [`find`] says of the object, [`AbortCode::NOT_MAPPABLE`],
    /// [`AbortCode::PDO_LENGTH`] for more than eight objects or bytes, [`AbortCode::PARAMETER`] in
    /// another order than that of CiA 301 clause 7.5.2.36: the PDO is made invalid, the number set
    /// to 0, the objects, the number, the PDO made valid.
    pub fn write(
        &mut self,
        at: Address,
        data: &[u8],
        dictionary: &[Entry],
        process: &impl Objects,
    ) -> Option<Result<(), AbortCode>> {
        let mut value = data.iter().rfold(0, |value, byte| value << 8 | u32::from(*byte));
        if at == SYNC {
            // Bit 31 has no meaning; bit 30 would make the device the producer.
            let id = u16::try_from(value & !INVALID).ok().and_then(CobId::new);
            let id = id.filter(|id| !is_restricted(id.get().into()));
            let Some(id) = id else { return Some(Err(AbortCode::INVALID_VALUE)) };
            self.identifiers_changed |= mem::replace(&mut self.sync, id) != id;
            return Some(Ok(()));
        }
        let pdo = self.find(at)?;
        let (is_cob_id, is_transmit) = ((at.index, at.sub) == (pdo.index, 1), pdo.is_transmit());
        if is_cob_id {
            // It says that there are no remote frames, whatever a master writes.
            value = value & !NO_RTR | if is_transmit { NO_RTR } else { 0 };
        }
        // The present value again changes nothing.
        if *pdo.parameter(at)?.0 == value {
            return Some(Ok(()));
        }
        if let Err(code) = pdo.check(at, value, dictionary, process) {
            return Some(Err(code));
        }
        *pdo.parameter(at)?.0 = value;
        if (at.index, at.sub) != (pdo.index, 5) {
            pdo.progress = Progress::default();
        }
        self.identifiers_changed |= is_cob_id && !is_transmit;
        Some(Ok(()))
    }

    /// The PDO with this parameter.
    fn find(&mut self, at: Address) -> Option<&mut Pdo> {
        self.pdos.iter_mut().find(|pdo| pdo.index == at.index & !0x200)
    }
}
