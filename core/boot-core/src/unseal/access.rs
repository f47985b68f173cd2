//! The functions of a sealed device that need a root key (2002h), and its event log (2003h).

use canopen::od::{put, Address};
use canopen::program::{FlashError, ACCESS, EVENTS};
use canopen::AbortCode;
use seal::access::{event, right, CHALLENGE, DOMAIN, REQUEST, SEALED, SIGNED_CHALLENGE, SIGNED_REQUEST};
use seal::key_block::{KEKS, KEY, ROOTS};
use seal::sha512::hash_256;
use seal::wire::{array, word, Fault, Head};

use super::image::{start, Room, Stage, Unsealer};
use crate::flash::Flash;
use crate::store::{Key, Value};

/// The number of events in the log.
const LAST: usize = seal::access::EVENTS;
/// The number of them that may be refusals, without that of a wrong signature.
const MOST_REFUSALS: usize = seal::access::MOST_REFUSALS;

// The constants that `seal`, `canopen` and `shared-abi` each define must agree.
const _: () = {
    assert!(canopen::program::SEALED_ENTRIES.len() == 4 + LAST);
    assert!(REQUEST <= canopen::sdo::server::VALUE_MAX);
    assert!(shared_abi::layout::KEY_BLOCK_SIZE as usize == seal::key_block::SIZE);
    assert!(FlashError::Signature.code() == Fault::Signature as u8);
    assert!(FlashError::Rollback.code() == Fault::Rollback as u8);
    assert!(FlashError::Key.code() == Fault::Key as u8);
};

impl Unsealer<'_> {
    /// Whether an action is permitted that needs a right in a sealed device, or none (0).
    pub(crate) fn permits(&self, right: u32) -> bool {
        self.room().is_none_or(|room| !room.takes_no_other || right == 0 || room.granted & right != 0)
    }

    /// Reads 2002h or 2003h; `None` for other objects.
    pub(crate) fn read(&mut self, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        let room = self.room_mut()?;
        match at.index {
            ACCESS => Some(put(buf, &room.challenge())),
            EVENTS => {
                // The latest event comes first.
                let event = room.events[room.event.wrapping_sub(u32::from(at.sub) - 1) as usize % LAST];
                let mut bytes = [0; 16];
                for (bytes, word) in bytes.chunks_exact_mut(4).zip(event) {
                    bytes.copy_from_slice(&word.to_le_bytes());
                }
                Some(put(buf, &bytes))
            }
            _ => None,
        }
    }

    /// A client asks for rights (2002h/2). The signature is checked in steps.
    ///
    /// # Errors
    /// An invalid request, or a key that is not a root of the device.
    pub(crate) fn ask<F: Flash>(&mut self, flash: &F, request: &[u8]) -> Result<(), AbortCode> {
        let Some(room) = self.room_mut() else { return Err(AbortCode::NO_OBJECT) };
        if request.len() != REQUEST {
            return Err(AbortCode::LENGTH);
        }
        let mut roots = (room.key_block + ROOTS as u32..room.key_block + KEKS as u32).step_by(KEY);
        let id = word(request, 8);
        let root = roots.find(|at| room.takes_no_other && id != 0 && flash.read_word(*at) == id);
        let root = root.ok_or(AbortCode::INVALID_VALUE)?;
        let mut key = [0; 32];
        flash.read(root + 4, &mut key);
        let challenge = room.challenge();
        let (asked, signature) = request.split_at(SIGNED_REQUEST);
        let message = [&DOMAIN[..], &challenge[..SIGNED_CHALLENGE], asked];
        start(&mut room.verification, &key, &array(signature, 0), &message);
        room.asked = (word(asked, 0), word(asked, 4));
        room.stage = Stage::Access;
        Ok(())
    }

    /// Returns the next value to store, once.
    pub(crate) fn take_store(&mut self) -> Option<(Key, Value)> {
        let room = self.room_mut()?;
        if core::mem::take(&mut room.stores.1) {
            return Some((Key::GRANTS, [room.grants, room.opened, 0, 0]));
        }
        let place = room.event as usize % LAST;
        core::mem::take(&mut room.stores.0).then(|| (Key::event(place as u8), room.events[place]))
    }

    /// Whether the signature of a request for rights is being checked.
    pub(crate) fn is_asked(&self) -> bool {
        self.room().is_some_and(|room| room.stage == Stage::Access)
    }

    /// Whether a signature was found good since the last call: that of a complete image, or that of
    /// a request for rights.
    pub(crate) fn take_authentic(&mut self) -> bool {
        self.room_mut().is_some_and(|room| core::mem::take(&mut room.authentic))
    }

    /// Records the result of the installation of a sealed image.
    pub(crate) fn end(&mut self, outcome: Result<(), FlashError>) {
        let Some(room) = self.room_mut() else { return };
        if room.active {
            let program = u32::from(room.program);
            match outcome {
                Ok(()) => {
                    room.authentic = true;
                    // Anybody may send the installed image again: this changes nothing.
                    if !room.same {
                        room.record(event::INSTALLED | program);
                    }
                }
                Err(error) => room.record(event::REFUSED | u32::from(error.code())),
            }
        }
        room.rest();
    }
}

impl Room {
    /// 2002h/1. Its nonce is valid until rights are granted for it, or until the next reset.
    fn challenge(&mut self) -> [u8; CHALLENGE] {
        let Some(policy) = self.policy else { return [0; CHALLENGE] };
        let unique_id = (policy.unique_id)();
        if self.nonce == [0; 32] {
            let parts = [&unique_id[..], &self.grants.to_le_bytes(), &(policy.cycles)().to_le_bytes()];
            self.nonce = hash_256(&parts);
        }
        let mut challenge = [0; CHALLENGE];
        challenge[..12].copy_from_slice(&unique_id);
        challenge[12..SIGNED_CHALLENGE].copy_from_slice(&self.nonce);
        let sealed = if self.takes_no_other { SEALED } else { 0 };
        challenge[SIGNED_CHALLENGE..].copy_from_slice(&(self.granted | sealed).to_le_bytes());
        challenge
    }

    /// Grants the rights after the signature was found good.
    pub(super) fn grant(&mut self) {
        let (rights, argument) = self.asked;
        self.granted |= rights;
        if rights & right::LOWER_COUNTER != 0 {
            self.argument = argument;
        }
        self.opened |= rights & right::OPEN;
        self.nonce = [0; 32];
        self.grants = self.grants.wrapping_add(1);
        self.stores.1 = true;
        self.authentic = true;
        self.stage = Stage::Head;
        self.record(event::UNLOCKED | rights & 0xFFFF);
    }

    /// Records an event, unless it is a refusal that must not be recorded. Anybody causes a refusal:
    /// he must neither wear out the flash nor push the other events out of the log. So a refusal
    /// that the log contains is not recorded again, and no further one if there are
    /// [`MOST_REFUSALS`], except a wrong signature, which is more likely to be an attack.
    fn record(&mut self, what: u32) {
        let head = Head(&self.head);
        let is_refusal = |what: u32| what >> 16 == event::REFUSED >> 16;
        if is_refusal(what) {
            let is_attack = what == event::REFUSED | u32::from(FlashError::Signature.code());
            let refusals = self.events.iter().filter(|[_, what, ..]| is_refusal(*what));
            if refusals.clone().any(|[_, known, ..]| *known == what)
                || refusals.count() >= MOST_REFUSALS && !is_attack
            {
                return;
            }
        }
        self.event += 1;
        self.events[self.event as usize % LAST] = [self.event, what, head.counter(), head.version()];
        self.stores.0 = true;
    }
}
