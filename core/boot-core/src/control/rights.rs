//! The functions of a sealed device that need a root key (2002h), and its event log (2003h).
//!
//! A device that takes no sealed images has neither: nothing there needs a right, and the objects do not
//! exist.

use canopen::od::{put, Address};
use canopen::program::{FlashError, ACCESS, EVENTS};
use canopen::AbortCode;
use seal::access::{
    event, right, CHALLENGE, DOMAIN, FLOOR, REQUEST, SEALED, SIGNED_CHALLENGE, SIGNED_REQUEST,
};
use seal::key_block::{KEKS, KEY, ROOTS, ROOT_COUNT};
use seal::sha512::hash_256;
use seal::wire::{array, word, Fault, HASH};
use shared_abi::layout::Layout;

use crate::flash::Flash;
use crate::keys::{floor, is_sealed, is_sound, Images, Linked, OfSealed};
use crate::policy::{Policy, SealPolicy};
use crate::store::{Key, Parameters, Value};
use crate::unseal::{Edition, News, Outcome, Request, Unsealer};

/// The most programs of a layout whose counters are told.
const PROGRAMS: usize = 2;
/// The number of events in the log.
const LAST: usize = seal::access::EVENTS;
/// The number of them that may be refusals, without that of a wrong signature.
const MOST_REFUSALS: usize = seal::access::MOST_REFUSALS;

// The constants that `seal`, `canopen` and `shared-abi` each define must agree.
const _: () = {
    assert!(canopen::program::SEALED_ENTRIES.len() == 5 + LAST);
    assert!(REQUEST <= canopen::sdo::server::VALUE_MAX);
    assert!(shared_abi::layout::KEY_BLOCK_SIZE as usize == seal::key_block::SIZE);
    assert!(FlashError::Signature.code() == Fault::Signature as u8);
    assert!(FlashError::Rollback.code() == Fault::Rollback as u8);
    assert!(FlashError::Key.code() == Fault::Key as u8);
};

/// The rights that were granted in a device, and its event log.
pub(crate) struct Rights<'b>(OfSealed<'b, Access>);

/// Their state.
pub(super) struct Access {
    policy: Option<&'static SealPolicy>,
    /// Address of the key block.
    key_block: u32,
    /// The device has keys and therefore accepts and starts only sealed programs.
    takes_no_other: bool,
    /// 2002h/3, as it was at the reset: roots, epoch, and a counter for each program.
    floor: [u32; FLOOR + PROGRAMS],
    /// Bytes of it.
    floor_len: usize,
    /// Rights granted since the reset, and the argument of the last grant.
    granted: u32,
    argument: u32,
    /// What is stored of the grants.
    grants: Grants,
    /// The nonce that is signed with a request; zeros until a client reads it.
    nonce: [u8; HASH],
    /// A signature was good, of a complete image or of a request, and nobody was told yet.
    authentic: bool,
    log: Log,
}

/// What a device keeps of all grants in its life.
struct Grants {
    count: u32,
    /// Not 0: the device is open from the next reset on.
    opened: u32,
    /// They must be stored when the flash is idle.
    is_changed: bool,
}

/// The event log.
struct Log {
    /// The number of the last event.
    last: u32,
    events: [Value; LAST],
    /// The last event must be stored when the flash is idle.
    is_changed: bool,
}

impl<'b> Rights<'b> {
    /// `None` in a device that takes no sealed images.
    pub(super) fn new(access: Option<&'b mut Access>) -> Self {
        Self(OfSealed::new(access))
    }

    /// Sets the properties of the device, and loads what is stored.
    pub(super) fn attach<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        layout: &Layout,
        policy: &'static Policy,
    ) {
        let Some(access) = self.0.get_mut() else { return };
        let log = &mut access.log;
        for (place, event) in (0..).zip(&mut log.events) {
            *event = parameters.get(flash, Key::event(place)).unwrap_or([0; 4]);
            log.last = log.last.max(event[0]);
        }
        let grants = &mut access.grants;
        [grants.count, grants.opened, ..] = parameters.get(flash, Key::GRANTS).unwrap_or([0; 4]);
        access.key_block = layout.key_block().base;
        access.policy = Some(&policy.seal);
        access.takes_no_other = is_sealed(flash, parameters, layout);
        if is_sound(flash, access.key_block) {
            for (at, id) in
                (access.key_block + ROOTS as u32..).step_by(KEY).zip(&mut access.floor[..ROOT_COUNT])
            {
                *id = flash.read_word(at);
            }
        }
        let programs = layout.programs.len().min(PROGRAMS);
        for number in 1..=programs {
            let (counter, epoch) = floor(flash, parameters, layout, policy.seal.counter, number as u8);
            access.floor[FLOOR + number - 1] = counter;
            access.floor[ROOT_COUNT] = epoch;
        }
        access.floor_len = 4 * (FLOOR + programs);
    }

    /// Whether the device takes sealed images.
    pub(crate) fn is_present(&self) -> bool {
        self.0.get().is_some()
    }

    /// Whether the device has keys and therefore accepts and starts only sealed programs.
    pub(crate) fn takes_no_other(&self) -> bool {
        self.0.get().is_some_and(|access| access.takes_no_other)
    }

    /// The images that the device takes.
    pub(super) fn images(&self) -> Images {
        match (self.0.get(), Linked::PROOF) {
            (Some(access), Some(linked)) if access.takes_no_other => Images::Sealed(linked),
            (Some(_), Some(linked)) => Images::Both(linked),
            _ => Images::Plain,
        }
    }

    /// Whether an action is permitted that needs a right in a sealed device, or none (0).
    pub(crate) fn permits(&self, right: u32) -> bool {
        self.0.get().is_none_or(|access| !access.takes_no_other || right == 0 || access.granted & right != 0)
    }

    /// The counter that the next image must have at least, if a client has the right to lower it.
    pub(super) fn lowered_counter(&self) -> Option<u32> {
        let access = self.0.get()?;
        (access.granted & right::LOWER_COUNTER != 0).then_some(access.argument)
    }

    /// Reads 2002h or 2003h; `None` for other objects.
    pub(crate) fn read(&mut self, at: Address, buf: &mut [u8]) -> Option<Result<usize, AbortCode>> {
        let access = self.0.get_mut()?;
        match at.index {
            ACCESS if at.sub == 3 => {
                let mut bytes = [0; 4 * (FLOOR + PROGRAMS)];
                for (bytes, word) in bytes.chunks_exact_mut(4).zip(access.floor) {
                    bytes.copy_from_slice(&word.to_le_bytes());
                }
                Some(put(buf, &bytes[..access.floor_len]))
            }
            ACCESS => Some(put(buf, &access.challenge())),
            EVENTS => {
                let mut bytes = [0; 16];
                for (bytes, word) in bytes.chunks_exact_mut(4).zip(access.log.event(at.sub)) {
                    bytes.copy_from_slice(&word.to_le_bytes());
                }
                Some(put(buf, &bytes))
            }
            _ => None,
        }
    }

    /// A client asks for rights (2002h/2). The unsealer checks the signature in steps.
    ///
    /// # Errors
    /// An invalid request, or a key that is not a root of the device.
    pub(super) fn ask<F: Flash>(
        &mut self,
        flash: &F,
        request: &[u8],
        unsealer: &mut Unsealer<'_>,
    ) -> Result<(), AbortCode> {
        let Some(access) = self.0.get_mut() else { return Err(AbortCode::NO_OBJECT) };
        if request.len() != REQUEST {
            return Err(AbortCode::LENGTH);
        }
        let mut roots = (access.key_block + ROOTS as u32..access.key_block + KEKS as u32).step_by(KEY);
        let id = word(request, 8);
        let root = roots.find(|at| access.takes_no_other && id != 0 && flash.read_word(*at) == id);
        let root = root.ok_or(AbortCode::INVALID_VALUE)?;
        let mut key = [0; 32];
        flash.read(root + 4, &mut key);
        let challenge = access.challenge();
        let (asked, signature) = request.split_at(SIGNED_REQUEST);
        let message = [&DOMAIN[..], &challenge[..SIGNED_CHALLENGE], asked];
        let request = Request { rights: word(asked, 0), argument: word(asked, 4) };
        unsealer.check(request, &key, &array(signature, 0), &message);
        Ok(())
    }

    /// Takes note of what the unsealer has found out. Events are recorded with the `edition` of the
    /// last image.
    pub(super) fn update(&mut self, news: News, edition: Edition) {
        let Some(access) = self.0.get_mut() else { return };
        if news.accepted {
            // The right is valid for one image.
            access.granted &= !right::LOWER_COUNTER;
        }
        access.authentic |= matches!(news.outcome, Outcome::Granted(_) | Outcome::Installed { .. });
        let event = match news.outcome {
            // Anybody may send the installed image again: this changes nothing.
            Outcome::None | Outcome::Installed { same: true, .. } => return,
            Outcome::Installed { program, .. } => event::INSTALLED | u32::from(program),
            Outcome::Refused(error) => event::REFUSED | u32::from(error.code()),
            Outcome::Granted(request) => {
                access.grant(request);
                event::UNLOCKED | request.rights & 0xFFFF
            }
        };
        access.log.record(event, edition);
    }

    /// Returns the next value to store, once.
    pub(super) fn take_note(&mut self) -> Option<(Key, Value)> {
        let Access { grants, log, .. } = self.0.get_mut()?;
        if core::mem::take(&mut grants.is_changed) {
            return Some((Key::GRANTS, [grants.count, grants.opened, 0, 0]));
        }
        let place = log.last as usize % LAST;
        core::mem::take(&mut log.is_changed).then(|| (Key::event(place as u8), log.events[place]))
    }

    /// Whether a signature was found good since the last call: that of a complete image, or that of
    /// a request for rights.
    pub(crate) fn take_authentic(&mut self) -> bool {
        self.0.get_mut().is_some_and(|access| core::mem::take(&mut access.authentic))
    }
}

impl Access {
    /// No rights, and an empty log. All of it is zero.
    pub(super) const fn new() -> Self {
        Self {
            policy: None,
            key_block: 0,
            takes_no_other: false,
            floor: [0; FLOOR + PROGRAMS],
            floor_len: 0,
            granted: 0,
            argument: 0,
            grants: Grants { count: 0, opened: 0, is_changed: false },
            nonce: [0; HASH],
            authentic: false,
            log: Log { last: 0, events: [[0; 4]; LAST], is_changed: false },
        }
    }

    /// 2002h/1. Its nonce is valid until rights are granted for it, or until the next reset.
    fn challenge(&mut self) -> [u8; CHALLENGE] {
        let Some(policy) = self.policy else { return [0; CHALLENGE] };
        let unique_id = (policy.unique_id)();
        if self.nonce == [0; HASH] {
            let parts = [&unique_id[..], &self.grants.count.to_le_bytes(), &(policy.cycles)().to_le_bytes()];
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
    fn grant(&mut self, Request { rights, argument }: Request) {
        self.granted |= rights;
        if rights & right::LOWER_COUNTER != 0 {
            self.argument = argument;
        }
        self.nonce = [0; HASH];
        self.grants.opened |= rights & right::OPEN;
        self.grants.count = self.grants.count.wrapping_add(1);
        self.grants.is_changed = true;
    }
}

impl Log {
    /// An event; the latest one is number 1.
    fn event(&self, number: u8) -> Value {
        self.events[self.last.wrapping_sub(u32::from(number) - 1) as usize % LAST]
    }

    /// Records an event, unless it is a refusal that must not be recorded. Anybody causes a refusal:
    /// he must neither wear out the flash nor push the other events out of the log. So a refusal
    /// that the log contains is not recorded again, and no further one if there are
    /// [`MOST_REFUSALS`], except a wrong signature, which is more likely to be an attack.
    fn record(&mut self, what: u32, Edition { counter, version }: Edition) {
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
        self.last += 1;
        self.events[self.last as usize % LAST] = [self.last, what, counter, version];
        self.is_changed = true;
    }
}
