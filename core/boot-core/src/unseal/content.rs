//! A sealed image with an authentic head: dictionary, chunks, and the last check of the flash.

use core::ops::Range;

use seal::chacha20;
use seal::sha512::Sha512;
use seal::wire::{flag, Fault, Head, HASH};
use shared_abi::geometry::Region;

use super::buffers::{Buffers, CARRY, PAYLOAD, UNPACK, UNPACKED};
use crate::flash::{fold, Flash};
use crate::queue::{Piece, Queue};
use crate::store::Value;

/// The number of bytes that one step hashes or decrypts.
const STEP: usize = 1024;

/// An image that is in the device already.
#[derive(Clone, Copy)]
pub(super) struct Same {
    /// Its place.
    pub place: Region,
    /// The record to store, as it was read: after a power cut it may read differently the next time.
    pub record: Value,
}

/// The device's decision about an image.
#[derive(Clone, Copy)]
pub(super) struct Acceptance {
    /// `Some`: the new one is checked and discarded.
    pub same: Option<Same>,
    /// The new counter.
    pub counter: Value,
}

/// The image after its head.
pub(super) struct Content {
    acceptance: Acceptance,
    chain: Chain,
    phase: Phase,
}

/// The chain of chunks.
struct Chain {
    /// The expected hash of the next chunk.
    next: [u8; HASH],
    /// The payload that is still to come, without the present chunk.
    left: u32,
    /// The bytes of the image that are in flash.
    done: u32,
    /// The other program, if it is the dictionary; otherwise an empty region.
    dictionary: Region,
}

/// The progress.
enum Phase {
    /// The dictionary is being hashed.
    Dictionary(Hashing),
    /// A chunk is being received.
    Chunk(Arrival),
    /// The chunk is authentic and is being written to flash.
    Payload(Payload),
    /// Everything is written, and is hashed again in flash.
    Image(Hashing),
}

/// Flash that is being hashed.
struct Hashing {
    /// The number of bytes so far.
    done: u32,
}

/// A chunk that is being received into the buffer.
struct Arrival {
    /// The offset in the buffer of the next byte, and the end of the chunk.
    have: usize,
    want: usize,
    /// The number of compressed bytes that the previous chunk left over: they are in the buffer
    /// before this one.
    rest: usize,
}

/// A chunk in the buffer.
struct Payload {
    /// It is decrypted up to this offset.
    clear: usize,
    /// The offset of the bytes that are not decompressed yet.
    packed: usize,
    /// The end of the chunk.
    end: usize,
    /// The next bytes for the flash.
    out: Range<usize>,
}

impl Content {
    pub(super) fn new(acceptance: Acceptance, dictionary: Option<Region>, buffers: &mut Buffers) -> Self {
        let head = Head(&buffers.head);
        buffers.lzma.reset();
        buffers.hash = Sha512::new_256();
        let mut chain = Chain {
            next: head.chain(),
            left: head.payload(),
            done: 0,
            dictionary: dictionary.unwrap_or(Region::new(0, 0)),
        };
        let phase = match dictionary {
            Some(_) => Phase::Dictionary(Hashing { done: 0 }),
            None => chain.next_chunk(head, 0),
        };
        Self { acceptance, chain, phase }
    }

    pub(super) const fn acceptance(&self) -> Acceptance {
        self.acceptance
    }

    /// Whether there is nothing to do before more bytes arrive.
    pub(super) const fn waits(&self) -> bool {
        matches!(self.phase, Phase::Chunk(_))
    }

    /// The next bytes for the flash of the program.
    pub(super) fn piece(&self, region: Region) -> Option<Piece> {
        let Phase::Payload(payload) = &self.phase else { return None };
        let size = payload.out.len() as u32;
        (size > 0).then(|| Piece { address: region.base + self.chain.done, size })
    }

    /// The offset of these bytes in the buffer.
    pub(super) const fn out(&self) -> usize {
        match &self.phase {
            Phase::Payload(payload) => payload.out.start,
            _ => 0,
        }
    }

    /// These bytes are in flash.
    pub(super) fn written(&mut self) {
        if let Phase::Payload(payload) = &mut self.phase {
            self.chain.done += core::mem::take(&mut payload.out).len() as u32;
        }
    }

    /// Continues with one bounded step; returns whether the image is installed.
    pub(super) fn advance<F: Flash>(
        &mut self,
        region: Region,
        buffers: &mut Buffers,
        flash: &F,
        queue: &mut Queue<'_>,
    ) -> Result<bool, Fault> {
        let chain = &mut self.chain;
        let head = Head(&buffers.head);
        // The number of bytes that are left over, when the next chunk may come.
        let rest = match &mut self.phase {
            Phase::Dictionary(hashing) => {
                let Some(hash) = hashing.step(flash, chain.dictionary, &mut buffers.hash) else {
                    return Ok(false);
                };
                if hash[..HASH] != *head.dictionary() {
                    return Err(Fault::WrongProduct);
                }
                0
            }
            Phase::Chunk(arrival) => {
                if !arrival.step(&mut buffers.bytes, &mut buffers.hash, queue) {
                    return Ok(false);
                }
                if buffers.hash.finish()[..HASH] != chain.next {
                    return Err(Fault::Signature);
                }
                chain.next.copy_from_slice(&buffers.bytes[CARRY..PAYLOAD]);
                if self.acceptance.same.is_none() {
                    self.phase = Phase::Payload(Payload::new(arrival, &mut buffers.bytes));
                    return Ok(false);
                }
                0
            }
            Phase::Payload(payload) => match payload.step(chain, region, buffers, flash)? {
                Some(rest) => rest,
                None => return Ok(false),
            },
            Phase::Image(hashing) => {
                let place = self.acceptance.same.map_or(region, |same| same.place);
                let image = Region::new(place.base, head.size());
                let Some(hash) = hashing.step(flash, image, &mut buffers.hash) else { return Ok(false) };
                if hash[..HASH] != *head.image_hash() {
                    return Err(Fault::Signature);
                }
                return Ok(true);
            }
        };
        buffers.hash = Sha512::new_256();
        self.phase = chain.next_chunk(Head(&buffers.head), rest);
        Ok(false)
    }
}

impl Chain {
    /// Continues after a chunk, of which so many compressed bytes are left over, or at the start.
    fn next_chunk(&mut self, head: Head<'_>, rest: usize) -> Phase {
        let size = self.left.min(1 << head.chunk());
        self.left -= size;
        if size == 0 {
            return Phase::Image(Hashing { done: 0 });
        }
        let want = PAYLOAD + size as usize;
        Phase::Chunk(Arrival { have: CARRY, want, rest })
    }
}

impl Hashing {
    /// Continues with one step; returns the hash after the last one.
    fn step<F: Flash>(&mut self, flash: &F, place: Region, hash: &mut Sha512) -> Option<[u8; 64]> {
        let size = (place.size - self.done).min(STEP as u32);
        if size == 0 {
            return Some(hash.finish());
        }
        let so_far = core::mem::replace(hash, Sha512::IDLE);
        *hash = fold(flash, so_far, Region::new(place.base + self.done, size), |mut hash, bytes| {
            hash.update(bytes);
            hash
        });
        self.done += size;
        None
    }
}

impl Arrival {
    /// Takes and hashes bytes; returns whether the chunk is complete.
    fn step(&mut self, bytes: &mut [u8], hash: &mut Sha512, queue: &mut Queue<'_>) -> bool {
        let end = self.want.min(self.have + STEP);
        let room = &mut bytes[self.have..end];
        let taken = queue.take(room);
        hash.update(&room[..taken]);
        self.have += taken;
        self.have == self.want
    }
}

impl Payload {
    /// A complete chunk. The bytes that the previous one left over are moved before its payload.
    fn new(chunk: &Arrival, bytes: &mut [u8]) -> Self {
        bytes.copy_within(CARRY - chunk.rest..CARRY, PAYLOAD - chunk.rest);
        Self { clear: PAYLOAD, packed: PAYLOAD - chunk.rest, end: chunk.want, out: 0..0 }
    }

    /// Decrypts and decompresses in bounded steps. When the chunk gives no more bytes, it returns
    /// the number of compressed bytes that are left over.
    fn step<F: Flash>(
        &mut self,
        chain: &Chain,
        region: Region,
        buffers: &mut Buffers,
        flash: &F,
    ) -> Result<Option<usize>, Fault> {
        let head = Head(&buffers.head);
        let size = head.size();
        if head.flags() & flag::ENCRYPTED != 0 && self.clear < self.end {
            let before = head.payload() - chain.left - (self.end - self.clear) as u32;
            let end = self.end.min(self.clear + STEP);
            let [nonce @ .., _, _, _, _] = head.nonce();
            chacha20::apply(&buffers.key, &nonce, before / 64, &mut buffers.bytes[self.clear..end]);
            self.clear = end;
            return Ok(None);
        }
        if head.flags() & flag::COMPRESSED == 0 && self.packed < self.end {
            self.out = self.packed..self.end;
            self.packed = self.end;
            return Ok(None);
        }
        let (input, out) = buffers.bytes.split_at_mut(UNPACKED);
        let last = chain.left == 0;
        let done = chain.done;
        let room = (size - done).min(UNPACK as u32) as usize;
        // The last symbol may give more bytes than are decompressed at a time, without any input
        // left.
        if (self.packed < self.end || last) && room > 0 {
            let (base, dictionary) = (region.base, chain.dictionary);
            let before = |distance: u32| {
                let mut byte = [0];
                // The image follows the dictionary. (The first byte of a dictionary with an odd
                // size is left out, so that odd positions stay odd positions of the image.)
                let from = if distance > done { dictionary.end() } else { base };
                flash.read(from.wrapping_add(done).wrapping_sub(distance), &mut byte);
                byte[0]
            };
            let input = &input[self.packed..self.end];
            let (consumed, produced) = buffers
                .lzma
                .decode(input, last, done + (dictionary.size & !1), &before, &mut out[..room])
                .map_err(|_| Fault::Format)?;
            self.packed += consumed;
            self.out = UNPACKED..UNPACKED + produced;
            if produced > 0 {
                return Ok(None);
            }
        }
        let rest = self.end - self.packed;
        if last && done < size || rest > CARRY {
            return Err(Fault::Format);
        }
        buffers.bytes.copy_within(self.packed..self.end, CARRY - rest);
        Ok(Some(rest))
    }
}
