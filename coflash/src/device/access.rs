//! A sealed device: what it does for the holder of a root key alone (2002h), and what it has recorded
//! (2003h). `seal::access` has the numbers.

use std::fmt;
use std::time::Duration;

use canopen::program::{ACCESS, EVENTS};
use canopen::Address;
use seal::access::{event, CHALLENGE, DOMAIN, SEALED, SIGNED_CHALLENGE};
use seal::wire::{array, word};

use super::{Doing, Error, Session};

/// How long a device may look at a signature.
const VERDICT: Duration = Duration::from_secs(2);
/// How often it is asked meanwhile.
const PERIOD: Duration = Duration::from_millis(50);

/// The rights in the last word of 2002h/1; beside them is [`SEALED`].
const RIGHTS: u32 = 0xFFFF;

/// What a device wants to be signed together with a request (2002h/1).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Challenge([u8; CHALLENGE]);

impl Challenge {
    /// The 96-bit unique ID of the chip.
    #[must_use]
    pub fn unique_id(&self) -> [u8; 12] {
        array(&self.0, 0)
    }

    /// The rights that are granted until the next reset (`seal::access::right`).
    #[must_use]
    pub fn granted(&self) -> u32 {
        word(&self.0, SIGNED_CHALLENGE) & RIGHTS
    }

    /// Whether the device is sealed: it has keys, and takes sealed images alone.
    #[must_use]
    pub fn is_sealed(&self) -> bool {
        word(&self.0, SIGNED_CHALLENGE) & SEALED != 0
    }

    /// What the holder of the root key signs: rights, their argument and the id of the key.
    #[must_use]
    pub fn tbs(&self, rights: u32, argument: u32, key_id: u32) -> Vec<u8> {
        let mut message = [&DOMAIN[..], &self.0[..SIGNED_CHALLENGE]].concat();
        message.extend(request(rights, argument, key_id));
        message
    }
}

fn request(rights: u32, argument: u32, key_id: u32) -> impl Iterator<Item = u8> {
    [rights, argument, key_id].into_iter().flat_map(u32::to_le_bytes)
}

/// Asks the device for its challenge.
///
/// # Errors
/// What a [read](Session::read) has; a device that takes no sealed images has no such object.
pub fn challenge(session: &mut Session<'_>) -> Result<Challenge, Error> {
    let bytes = session.read(Address::new(ACCESS, 1))?;
    Ok(Challenge(array(&bytes, 0)))
}

/// The same, of a device that may have no such object: `None` then, and where what it tells is none.
///
/// # Errors
/// As [`challenge`], but for a refusal.
pub fn told_challenge(session: &mut Session<'_>) -> Result<Option<Challenge>, Error> {
    match session.read(Address::new(ACCESS, 1)) {
        Ok(bytes) => Ok(bytes.try_into().ok().map(Challenge)),
        Err(Error::Refused { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}

/// Asks for rights with the signature of a root over [`Challenge::tbs`]; whether all are granted.
///
/// # Errors
/// What a [write](Session::write) has: 06090030h from a device that does not have the key,
/// 08000022h from one that works, or waits after a wrong signature.
pub fn ask(
    session: &mut Session<'_>,
    (rights, argument, key_id): (u32, u32, u32),
    signature: &[u8; 64],
) -> Result<bool, Error> {
    let at = Address::new(ACCESS, 2);
    let bytes: Vec<u8> = request(rights, argument, key_id).chain(*signature).collect();
    session.write(at, &bytes, Doing::Write(at), &mut |_| {})?;
    let deadline = session.now() + VERDICT;
    loop {
        if challenge(session)?.granted() & rights == rights {
            // It records that, and takes no command meanwhile.
            session.wait(PERIOD)?;
            return Ok(true);
        }
        if session.now() >= deadline {
            return Ok(false);
        }
        session.wait(PERIOD)?;
    }
}

/// Something that a device has recorded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// 1 is the first of the device's life.
    pub number: u32,
    /// The kind in the upper half, its detail in the lower half (`seal::access::event`).
    pub what: u32,
    /// Security counter of the image that it is about.
    pub counter: u32,
    /// Its version.
    pub version: u32,
}

impl fmt::Display for Event {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let detail = self.what & 0xFFFF;
        let image = |f: &mut fmt::Formatter<'_>| {
            write!(f, " (counter {}, version {:08X}h)", self.counter, self.version)
        };
        write!(f, "{:>6}  ", self.number)?;
        match self.what & !0xFFFF {
            event::INSTALLED => write!(f, "program {detail} installed").and_then(|()| image(f)),
            event::REFUSED => match canopen::program::FlashError::from_code(detail as u8) {
                Some(error) => write!(f, "refused: {error}").and_then(|()| image(f)),
                None => write!(f, "refused").and_then(|()| image(f)),
            },
            event::UNLOCKED => write!(f, "rights granted: {detail:#04x}"),
            _ => write!(f, "unknown event {:08X}h", self.what),
        }
    }
}

/// What the device has recorded last, the newest first.
///
/// # Errors
/// What a [read](Session::read) has; a device that takes no sealed images has no such object.
pub fn events(session: &mut Session<'_>) -> Result<Vec<Event>, Error> {
    let mut events = Vec::new();
    for place in 1..=seal::access::EVENTS as u8 {
        let bytes = session.read(Address::new(EVENTS, place))?;
        let [number, what, counter, version] = [0, 4, 8, 12].map(|at| word(&bytes, at));
        if number > 0 {
            events.push(Event { number, what, counter, version });
        }
    }
    Ok(events)
}
