//! Processes sealed images between the queue and the flash: checks, authenticates, decrypts and
//! decompresses them (`seal::wire` has the format, docs/security.md the purpose).
//!
//! The order is essential: nothing is decrypted, decompressed or written before it is authentic.
//! The head is held until its signatures are found good; each chunk is held until its hash matches
//! the one in the previous authentic chunk.

use canopen::program::FlashError;
use seal::access::{right, EVENTS};
use seal::chacha20;
use seal::ed25519::Verification;
use seal::judge::{judge, Device, Needs};
use seal::key_block::{self, KEKS, KEK_COUNT, KEY};
use seal::lzma::Decoder;
use seal::sha512::{hmac, Sha512};
use seal::wire::{
    array, flag, head_size, Fault, Head, Recipient, DOMAIN, HASH, MAX_CHUNK, MAX_HEAD, WRAP_DOMAIN,
};
use shared_abi::geometry::Region;
use shared_abi::layout::Layout;

use crate::flash::{fold, Flash};
use crate::keys::{is_sealed, is_sound, Images, Linked};
use crate::policy::{Policy, SealPolicy};
use crate::program::Expected;
use crate::queue::{Piece, Queue};
use crate::store::record::Seal;
use crate::store::{Key, Parameters, ProgramRecord, Value};

/// The number of bytes that one step hashes.
const STEP: usize = 1024;
/// The most bytes that the decoder leaves for the next chunk.
const CARRY: usize = 24;
/// The offset of a chunk's payload in the buffer: after the rest of the previous chunk, and after
/// the hash of the next one.
const PAYLOAD: usize = CARRY + HASH;
/// The offset of the decompressed bytes for the flash: after the largest chunk.
const UNPACKED: usize = PAYLOAD + (1 << MAX_CHUNK);
/// The number of bytes that are decompressed at a time.
const UNPACK: usize = 512;

/// The progress of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stage {
    /// The head is being received.
    Head,
    /// The root's signature over the certificate is being checked.
    Certificate,
    /// The signature over the manifest is being checked.
    Manifest,
    /// The signature of a request for rights is being checked; there is no image.
    Access,
    /// The other program, which is the dictionary, is being hashed.
    Dictionary,
    /// A chunk is being received.
    Chunk,
    /// The chunk is authentic and is being written to flash.
    Payload,
    /// Everything is written, and is hashed again in flash.
    Image,
    /// The flash contains the image.
    Installed,
}

/// The processing of a sealed image, in a device that takes them.
pub struct Unsealer<'b>(Option<&'b mut Room>);

/// Its state. The state is large, and therefore not a part of the bootloader's structure.
pub struct Room {
    pub(super) policy: Option<&'static SealPolicy>,
    layout: Option<&'static Layout>,
    /// Address of the key block.
    pub(super) key_block: u32,
    pub(super) takes_no_other: bool,
    /// Rights granted since the reset, and the argument of the last grant.
    pub(super) granted: u32,
    pub(super) argument: u32,
    /// The number of grants in the device's life.
    pub(super) grants: u32,
    /// Not 0: the device is open from the next reset on.
    pub(super) opened: u32,
    /// The nonce that is signed with a request; zeros until a client reads it.
    pub(super) nonce: [u8; HASH],
    /// The requested rights while their signature is being checked, and their argument.
    pub(super) asked: (u32, u32),
    /// The number of the last event, and the events.
    pub(super) event: u32,
    pub(super) events: [Value; EVENTS],
    /// What must be stored when the flash is idle: the last event, the number of grants.
    pub(super) stores: (bool, bool),
    /// A signature was good, of a complete image or of a request, and nobody was told yet.
    pub(super) authentic: bool,
    pub(super) active: bool,
    pub(super) stage: Stage,
    pub(super) program: u8,
    /// The same image is already installed: the new one is checked and discarded.
    pub(super) same: bool,
    /// The record of the installed image.
    record: Value,
    /// The new counter is not stored yet.
    raises: bool,
    /// The program's flash.
    region: Region,
    /// The other program, if it is the dictionary; otherwise an empty region.
    dictionary: Region,
    /// The bytes of the head or of the chunk that have arrived, and the required number.
    have: usize,
    want: usize,
    /// The payload that is still to come, without this chunk.
    left: u32,
    /// The bytes of the image that are in flash, or the bytes of the flash that are hashed.
    done: u32,
    /// The offset in the buffer of the next bytes for the flash, and their number.
    out: (usize, usize),
    /// The payload in the buffer is decrypted up to this offset.
    clear: usize,
    /// The offset in the buffer of the bytes that are not decompressed yet.
    packed: usize,
    /// The new counter.
    counter: Value,
    needs: Needs,
    /// The expected hash of the next chunk.
    next: [u8; HASH],
    key: [u8; 32],
    hash: Sha512,
    pub(super) verification: Verification,
    lzma: Decoder,
    pub(super) head: [u8; MAX_HEAD],
    bytes: [u8; UNPACKED + UNPACK],
}

impl Default for Room {
    fn default() -> Self {
        Self::new()
    }
}

impl Room {
    /// The state for one image at a time.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            policy: None,
            layout: None,
            key_block: 0,
            takes_no_other: false,
            granted: 0,
            argument: 0,
            grants: 0,
            opened: 0,
            nonce: [0; HASH],
            asked: (0, 0),
            event: 0,
            events: [[0; 4]; EVENTS],
            stores: (false, false),
            authentic: false,
            active: false,
            stage: Stage::Head,
            program: 0,
            same: false,
            record: [0; 4],
            raises: false,
            region: Region::new(0, 0),
            dictionary: Region::new(0, 0),
            have: 0,
            want: 0,
            left: 0,
            done: 0,
            out: (0, 0),
            clear: 0,
            packed: 0,
            counter: [0; 4],
            needs: Needs { root: 0, epoch: 0, recipient: None },
            next: [0; HASH],
            key: [0; 32],
            hash: Sha512::IDLE,
            verification: Verification::IDLE,
            lzma: Decoder::new(),
            head: [0; MAX_HEAD],
            bytes: [0; UNPACKED + UNPACK],
        }
    }

    /// The interface to this state.
    pub fn unsealer(&mut self) -> Unsealer<'_> {
        Unsealer(Some(self))
    }

    /// Ends the processing of an image.
    pub(super) fn rest(&mut self) {
        self.active = false;
        self.stage = Stage::Head;
    }
}

impl Unsealer<'_> {
    /// For a device that takes no sealed images.
    pub const NONE: Self = Self(None);

    /// The state, in a device that takes sealed images.
    pub(super) fn room(&self) -> Option<&Room> {
        Linked::PROOF.and(self.0.as_deref())
    }

    /// See [`room`](Self::room).
    pub(super) fn room_mut(&mut self) -> Option<&mut Room> {
        Linked::PROOF.and(self.0.as_deref_mut())
    }

    /// Whether the device takes sealed images.
    pub(crate) fn is_present(&self) -> bool {
        self.room().is_some()
    }

    /// The images that the device takes.
    pub(crate) fn images(&self) -> Images {
        match (self.room(), Linked::PROOF) {
            (Some(room), Some(linked)) if room.takes_no_other => Images::Sealed(linked),
            (Some(_), Some(linked)) => Images::Both(linked),
            _ => Images::Plain,
        }
    }

    /// Whether the present download is a sealed image.
    pub(crate) fn is_active(&self) -> bool {
        self.room().is_some_and(|room| room.active)
    }

    /// Ends the processing of a sealed image.
    pub(crate) fn rest(&mut self) {
        if let Some(room) = self.room_mut() {
            room.rest();
        }
    }

    /// Sets the properties of the device.
    pub(crate) fn attach<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        layout: &'static Layout,
        policy: &'static Policy,
    ) {
        let Some(room) = self.room_mut() else { return };
        for (place, event) in (0..).zip(&mut room.events) {
            *event = parameters.get(flash, Key::event(place)).unwrap_or([0; 4]);
            room.event = room.event.max(event[0]);
        }
        [room.grants, room.opened, ..] = parameters.get(flash, Key::GRANTS).unwrap_or([0; 4]);
        room.layout = Some(layout);
        room.key_block = layout.key_block().base;
        room.policy = Some(&policy.seal);
        room.takes_no_other = is_sealed(flash, parameters, layout);
    }

    /// Whether the device has keys and therefore accepts and starts only sealed programs.
    pub(crate) fn takes_no_other(&self) -> bool {
        self.room().is_some_and(|room| room.takes_no_other)
    }

    /// Starts an image for this program.
    pub(crate) fn begin(&mut self, program: u8, region: Region) {
        let Some(room) = self.room_mut() else { return };
        room.active = true;
        room.stage = Stage::Head;
        room.program = program;
        room.region = region;
        room.have = 0;
        room.want = 8;
        room.out.1 = 0;
        room.raises = true;
        room.same = false;
    }

    /// Whether there is nothing to do before more bytes arrive.
    pub(crate) fn waits(&self) -> bool {
        self.room().is_none_or(|room| matches!(room.stage, Stage::Head | Stage::Chunk | Stage::Installed))
    }

    /// Whether the flash contains the image.
    pub(crate) fn is_installed(&self) -> bool {
        self.room().is_some_and(|room| room.stage == Stage::Installed)
    }

    /// Whether it was already installed before.
    pub(crate) fn is_same(&self) -> bool {
        self.room().is_some_and(|room| room.same)
    }

    /// Its record as it was read at that time: after a power cut it may read differently the next
    /// time.
    pub(crate) fn same_record(&self) -> Value {
        self.room().map_or([0; 4], |room| room.record)
    }

    /// The next bytes for the flash.
    pub(crate) fn piece(&self) -> Option<Piece> {
        let room = self.room()?;
        let size = room.out.1 as u32;
        (size > 0).then(|| Piece { address: room.region.base + room.done, size })
    }

    /// A byte of these bytes.
    pub(crate) fn data(&self, offset: usize) -> u8 {
        self.room().and_then(|room| room.bytes.get(room.out.0 + offset).copied()).unwrap_or(0)
    }

    /// These bytes are in flash.
    pub(crate) fn written(&mut self) {
        let Some(room) = self.room_mut() else { return };
        room.done += room.out.1 as u32;
        room.out.1 = 0;
    }

    /// The expected properties of the program.
    pub(crate) fn expected(&self) -> Expected {
        let head = self.room().map(|room| Head(&room.head));
        head.map_or(Expected { size: 0, crc: None }, |head| Expected {
            size: head.size(),
            crc: Some(head.crc()),
        })
    }

    /// Returns the new counter, once.
    pub(crate) fn take_counter(&mut self) -> Option<Value> {
        let room = self.room_mut()?;
        core::mem::take(&mut room.raises).then_some(room.counter)
    }

    /// Marks the record of a program that was installed as a sealed image.
    pub(crate) fn mark(&self, record: ProgramRecord) -> ProgramRecord {
        let Some(room) = self.room().filter(|room| room.active) else { return record };
        let head = Head(&room.head);
        let writes = head.flags() & flag::WRITES_FLASH != 0;
        let seal = if writes { Seal::WritesFlash } else { Seal::Locked };
        ProgramRecord { version: head.version(), seal: Some(seal), ..record }
    }

    /// Continues with one bounded step.
    pub(crate) fn step<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        queue: &mut Queue<'_>,
    ) -> Result<(), FlashError> {
        let Some(room) = self.room_mut() else { return Ok(()) };
        room.advance(flash, parameters, queue)
            .map_err(|fault| FlashError::from_code(fault as u8).unwrap_or(FlashError::Unspecified))
    }
}

impl Room {
    fn advance<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        queue: &mut Queue<'_>,
    ) -> Result<(), Fault> {
        match self.stage {
            Stage::Head => {
                let room = self.head.get_mut(self.have..self.want).ok_or(Fault::Format)?;
                self.have += queue.take(room);
                if self.have < self.want {
                    return Ok(());
                }
                self.want = head_size(&self.head[..self.have])?;
                if self.have == self.want {
                    self.judge(flash, parameters)?;
                }
            }
            Stage::Certificate | Stage::Manifest | Stage::Access => match self.verification.step() {
                None => {}
                Some(false) => return Err(Fault::Signature),
                Some(true) if self.stage == Stage::Certificate => self.check_manifest(None)?,
                Some(true) if self.stage == Stage::Manifest => self.open(flash, parameters)?,
                Some(true) => self.grant(),
            },
            Stage::Chunk => {
                let end = self.want.min(self.have + STEP);
                let room = &mut self.bytes[self.have..end];
                let taken = queue.take(room);
                self.hash.update(&room[..taken]);
                self.have += taken;
                if self.have == self.want {
                    self.check_chunk()?;
                }
            }
            Stage::Payload => self.unpack(flash)?,
            Stage::Dictionary | Stage::Image => {
                let head = Head(&self.head);
                let (place, told) = if self.stage == Stage::Image {
                    (Region::new(self.region.base, head.size()), head.image_hash())
                } else {
                    (self.dictionary, head.dictionary())
                };
                let size = (place.size - self.done).min(STEP as u32);
                let place = Region::new(place.base + self.done, size);
                let hash = core::mem::replace(&mut self.hash, Sha512::IDLE);
                self.hash = fold(flash, hash, place, |mut hash, bytes| {
                    hash.update(bytes);
                    hash
                });
                self.done += size;
                if size == 0 {
                    let differs = self.hash.finish()[..HASH] != *told;
                    match self.stage {
                        Stage::Image if differs => return Err(Fault::Signature),
                        Stage::Image => self.stage = Stage::Installed,
                        _ if differs => return Err(Fault::WrongProduct),
                        _ => self.begin_chunks(),
                    }
                }
            }
            Stage::Installed => {}
        }
        Ok(())
    }

    /// Checks the complete head.
    fn judge<F: Flash>(&mut self, flash: &F, parameters: &impl Parameters) -> Result<(), Fault> {
        let block = self.key_block;
        let policy = self.policy.ok_or(Fault::Key)?;
        // The key block without the secret keys; only the ids of these are read.
        let mut keys = [0; KEKS + KEK_COUNT * KEY];
        if is_sound(flash, block) {
            flash.read(block, &mut keys[..KEKS]);
            for at in (KEKS..).step_by(KEY).take(KEK_COUNT) {
                flash.read(block + at as u32, &mut keys[at..at + 4]);
            }
        }
        let word = |at| seal::wire::word(&keys, at);
        let record = ProgramRecord::load(parameters, flash, self.program);
        let counters = |program| parameters.get(flash, Key::counter(program)).unwrap_or([0; 4]);
        let [mut counter, _, installed, _] = counters(self.program);
        // The epoch is the device's: a key that is revoked for one program signs for none.
        let programs = self.layout.map_or(0, |layout| layout.programs.len() as u8);
        let epoch = (1..=programs).fold(word(key_block::EPOCH), |epoch, program| {
            let [_, proved, ..] = counters(program);
            epoch.max(proved)
        });
        // A program that has proved itself has raised the counter, if the policy raises it at
        // confirmation.
        if record.is_some_and(|record| record.confirmed) {
            counter = counter.max(installed);
        }
        counter = counter.max(word(key_block::COUNTER)).max(policy.counter);
        if self.granted & right::LOWER_COUNTER != 0 {
            counter = counter.min(self.argument);
        }
        let head = Head(&self.head);
        self.needs = judge(
            head,
            &Device {
                vendor_id: policy.vendor_id,
                product_code: policy.product_code,
                revision: policy.revision,
                unique_id: (policy.unique_id)(),
                program: self.program,
                is_data: policy.data == Some(self.program),
                room: self.region.size,
                counter,
                epoch,
                keys: &keys,
            },
        )?;
        self.same = record.is_some_and(|record| {
            record.seal.is_some()
                && (record.size, record.crc, record.version) == (head.size(), head.crc(), head.version())
        }) && installed == head.counter();
        self.record = record.map_or([0; 4], |record| record.value());
        let floor = if policy.counter_with_confirmation { counter } else { head.counter() };
        self.counter = [floor, self.needs.epoch, head.counter(), 0];
        let root = &keys[self.needs.root + 4..][..32];
        let root = root.try_into().map_err(|_| Fault::Key)?;
        match head.certificate() {
            Some(certificate) => {
                self.stage = Stage::Certificate;
                let signature = certificate.signature();
                start(&mut self.verification, root, &signature, &[certificate.signed()]);
                Ok(())
            }
            None => self.check_manifest(Some(root)),
        }
    }

    /// Starts to check the signature over the manifest, with this root or with the key in the
    /// certificate.
    fn check_manifest(&mut self, root: Option<&[u8; 32]>) -> Result<(), Fault> {
        let head = Head(&self.head);
        let certified = head.certificate().map(|certificate| certificate.key());
        let key = certified.as_ref().or(root).ok_or(Fault::Key)?;
        let signature = head.signature(key_id(key)).ok_or(Fault::Signature)?;
        self.stage = Stage::Manifest;
        start(&mut self.verification, key, signature, &[DOMAIN, head.manifest()]);
        Ok(())
    }

    /// Continues after the manifest was found authentic.
    fn open<F: Flash>(&mut self, flash: &F, parameters: &impl Parameters) -> Result<(), Fault> {
        let head = Head(&self.head);
        if let Some((at, recipient)) = &self.needs.recipient {
            let recipient = array(head.0, *recipient);
            let recipient = Recipient(&recipient);
            let mut secret = [0; 32];
            flash.read(self.key_block + *at as u32 + 4, &mut secret);
            let stream = hmac(&secret, &[WRAP_DOMAIN, &head.nonce()]);
            // From here on no copy of it is left in RAM.
            secret = [0; 32];
            core::hint::black_box(&secret);
            if stream[32..40] != recipient.check() {
                return Err(Fault::Key);
            }
            for ((key, wrapped), stream) in self.key.iter_mut().zip(recipient.wrapped()).zip(stream) {
                *key = wrapped ^ stream;
            }
        }
        // The right is valid for one image.
        self.granted &= !right::LOWER_COUNTER;
        self.dictionary = Region::new(0, 0);
        if head.flags() & flag::DICTIONARY == 0 {
            self.begin_chunks();
            return Ok(());
        }
        // The other one of two programs.
        let other = 3_u8.wrapping_sub(self.program);
        let place = self.layout.and_then(|layout| layout.program(other));
        let record = ProgramRecord::load(parameters, flash, other);
        let (Some(place), Some(record)) = (place, record) else { return Err(Fault::WrongProduct) };
        self.dictionary = Region::new(place.base, record.size.min(place.size));
        self.hash = Sha512::new_256();
        self.done = 0;
        self.stage = Stage::Dictionary;
        Ok(())
    }

    /// Continues when everything but the chunks is known.
    fn begin_chunks(&mut self) {
        let head = Head(&self.head);
        self.next = head.chain();
        self.left = head.payload();
        self.done = 0;
        self.packed = CARRY;
        self.lzma.reset();
        self.next_chunk();
    }

    fn next_chunk(&mut self) {
        let payload = self.left.min(1 << Head(&self.head).chunk());
        self.left -= payload;
        self.have = CARRY;
        self.want = PAYLOAD + payload as usize;
        self.hash = Sha512::new_256();
        self.stage = if payload > 0 { Stage::Chunk } else { Stage::Image };
        if payload == 0 {
            self.done = 0;
        }
    }

    /// Checks a complete chunk.
    fn check_chunk(&mut self) -> Result<(), Fault> {
        if self.hash.finish()[..HASH] != self.next {
            return Err(Fault::Signature);
        }
        self.next.copy_from_slice(&self.bytes[CARRY..PAYLOAD]);
        if self.same {
            self.next_chunk();
            return Ok(());
        }
        self.stage = Stage::Payload;
        self.clear = PAYLOAD;
        // The compressed bytes that the previous chunk left over are moved in front of this one.
        let left = CARRY - self.packed;
        self.bytes.copy_within(self.packed..CARRY, PAYLOAD - left);
        self.packed = PAYLOAD - left;
        Ok(())
    }

    /// Writes the payload to flash.
    fn unpack<F: Flash>(&mut self, flash: &F) -> Result<(), Fault> {
        let head = Head(&self.head);
        let size = head.size();
        if head.flags() & flag::ENCRYPTED != 0 && self.clear < self.want {
            let before = head.payload() - self.left - (self.want - self.clear) as u32;
            let end = self.want.min(self.clear + STEP);
            let [nonce @ .., _, _, _, _] = head.nonce();
            chacha20::apply(&self.key, &nonce, before / 64, &mut self.bytes[self.clear..end]);
            self.clear = end;
            return Ok(());
        }
        if head.flags() & flag::COMPRESSED == 0 && self.packed < self.want {
            self.out = (self.packed, self.want - self.packed);
            self.packed = self.want;
            return Ok(());
        }
        let (input, out) = self.bytes.split_at_mut(UNPACKED);
        let last = self.left == 0;
        let done = self.done;
        let room = (size - done).min(UNPACK as u32) as usize;
        // The last symbol may give more bytes than are decompressed at a time, without any input
        // left.
        if (self.packed < self.want || last) && room > 0 {
            let (base, dictionary) = (self.region.base, self.dictionary);
            let before = |distance: u32| {
                let mut byte = [0];
                // The image follows the dictionary. (The first byte of a dictionary with an odd
                // size is left out, so that odd positions stay odd positions of the image.)
                let from = if distance > done { dictionary.end() } else { base };
                flash.read(from.wrapping_add(done).wrapping_sub(distance), &mut byte);
                byte[0]
            };
            let input = &input[self.packed..self.want];
            let (consumed, produced) = self
                .lzma
                .decode(input, last, done + (dictionary.size & !1), &before, &mut out[..room])
                .map_err(|_| Fault::Format)?;
            self.packed += consumed;
            self.out = (UNPACKED, produced);
            if produced > 0 {
                return Ok(());
            }
        }
        // This chunk gives no more bytes.
        let rest = self.want - self.packed;
        if last && done < size || rest > CARRY {
            return Err(Fault::Format);
        }
        self.bytes.copy_within(self.packed..self.want, CARRY - rest);
        self.packed = CARRY - rest;
        self.next_chunk();
        Ok(())
    }
}

/// The new counter of a program before its record is removed: the counter of a program that has
/// proved itself. It is stored even if it already has this value: after a power cut it may read
/// this way now and differently later. (The store writes nothing if it is certain.)
pub(crate) fn proved<F: Flash>(flash: &F, parameters: &impl Parameters, program: u8) -> Option<Value> {
    let record = ProgramRecord::load(parameters, flash, program)?;
    let [counter, epoch, installed, _] = parameters.get(flash, Key::counter(program))?;
    (record.confirmed && installed >= counter).then_some([installed, epoch, installed, 0])
}

/// Starts to check a signature.
pub(super) fn start(
    verification: &mut Verification,
    key: &[u8; 32],
    signature: &[u8; 64],
    message: &[&[u8]],
) {
    let mut hash = Sha512::new();
    hash.update(&signature[..32]);
    hash.update(key);
    for part in message {
        hash.update(part);
    }
    *verification = Verification::new(key, signature, &hash.finish());
}

/// The id of a key: the first four bytes of its hash.
fn key_id(key: &[u8; 32]) -> u32 {
    let mut hash = Sha512::new();
    hash.update(key);
    seal::wire::word(&hash.finish(), 0)
}
