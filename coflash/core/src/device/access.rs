//! Access to a sealed device: the functions that need a root key (2002h), and the event log
//! (2003h). `seal::access` defines the numbers.

use std::fmt;
use std::time::Duration;

use canopen::program::{ACCESS, EVENTS};
use canopen::Address;
use seal::access::{event, CHALLENGE, DOMAIN, SEALED, SIGNED_CHALLENGE};
use seal::key_block::ROOT_COUNT;
use seal::wire::{array, word};
use serde::Serialize;

use super::doing::Doing;
use super::error::{reported, roots_words, Error};
use super::session::Session;
use crate::json;

/// How long a device may take to check a signature.
const VERDICT: Duration = Duration::from_secs(2);
/// The pause between two requests meanwhile.
const PERIOD: Duration = Duration::from_millis(50);

/// The rights in the last word of 2002h/1; the word also contains [`SEALED`].
const RIGHTS: u32 = 0xFFFF;

/// The bytes that the device wants signed together with a request (2002h/1).
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

    /// Whether the device is sealed: it has keys, and accepts only sealed images.
    #[must_use]
    pub fn is_sealed(&self) -> bool {
        word(&self.0, SIGNED_CHALLENGE) & SEALED != 0
    }

    /// The bytes that the holder of the root key signs: rights, their argument, and the id of the
    /// key.
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

/// Reads the device's challenge.
///
/// # Errors
/// The errors of a [read](Session::read). A device without support for sealed images does not have
/// this object.
pub fn challenge(session: &mut Session<'_>) -> Result<Challenge, Error> {
    let at = Address::new(ACCESS, 1);
    let bytes = session.read(at)?.try_into().map_err(|_| Error::wrong_length(at))?;
    Ok(Challenge(bytes))
}

/// What a device reports about the images that it takes. `Display` shows it in one line.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[non_exhaustive]
pub struct Security {
    /// The device has keys, and takes only sealed images.
    pub sealed: bool,
    /// The ids of its root keys.
    #[serde(serialize_with = "json::ids")]
    pub roots: Vec<u32>,
    /// The lowest security counter of an image that the device accepts, for each program from number
    /// 1 on.
    pub counters: Vec<u32>,
    /// The lowest epoch of a key that the device accepts.
    pub epoch: Option<u32>,
}

/// Reads what a device reports about the images that it takes; `None` if it has no such objects.
///
/// # Errors
/// The errors of a [read](Session::read), except a refusal.
pub fn security(session: &mut Session<'_>) -> Result<Option<Security>, Error> {
    match reported(challenge(session))? {
        Some(challenge) => security_of(session, &challenge).map(Some),
        None => Ok(None),
    }
}

/// Checks that a device takes images that are not sealed; returns whether it has said so.
///
/// # Errors
/// [`Error::SealedOnly`], and the errors of a [read](Session::read).
pub(crate) fn takes_open(session: &mut Session<'_>) -> Result<bool, Error> {
    match reported(challenge(session))? {
        Some(challenge) if challenge.is_sealed() => {
            let roots = security_of(session, &challenge)?.roots;
            Err(Error::SealedOnly { node: session.node(), roots })
        }
        challenge => Ok(challenge.is_some()),
    }
}

/// The same for a device with this challenge.
///
/// # Errors
/// Those of [`security`].
pub(crate) fn security_of(session: &mut Session<'_>, challenge: &Challenge) -> Result<Security, Error> {
    let bytes = reported(session.read(Address::new(ACCESS, 3)))?.unwrap_or_default();
    let mut words = bytes.chunks_exact(4).map(|bytes| word(bytes, 0));
    Ok(Security {
        sealed: challenge.is_sealed(),
        roots: words.by_ref().take(ROOT_COUNT).filter(|id| *id != 0).collect(),
        epoch: words.next(),
        counters: words.collect(),
    })
}

impl fmt::Display for Security {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.sealed {
            return f.write_str("no, it has no keys");
        }
        f.write_str("yes")?;
        if !self.roots.is_empty() {
            write!(f, ", {}", roots_words(&self.roots))?;
        }
        match self.counters.as_slice() {
            [] => {}
            [counter] => write!(f, ", counter {counter}")?,
            counters => {
                let counters: Vec<String> = counters.iter().map(u32::to_string).collect();
                write!(f, ", counters {}", counters.join(", "))?;
            }
        }
        match self.epoch {
            Some(epoch) => write!(f, ", epoch {epoch}"),
            None => Ok(()),
        }
    }
}

/// Asks for rights with the signature of a root over [`Challenge::tbs`]. Returns whether the device
/// has granted all of them.
///
/// # Errors
/// The errors of a [write](Session::write): 06090030h from a device that does not have the key,
/// 08000022h from a device that is busy, or that waits after a wrong signature.
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
            // The device records the grant, and accepts no command meanwhile.
            session.wait(PERIOD)?;
            return Ok(true);
        }
        if session.now() >= deadline {
            return Ok(false);
        }
        session.wait(PERIOD)?;
    }
}

/// An entry of the device's event log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Event {
    /// The entry's number; 1 is the first entry in the device's life.
    pub number: u32,
    /// The kind in the upper half, its detail in the lower half (`seal::access::event`).
    pub what: u32,
    /// Security counter of the image that the entry concerns.
    pub counter: u32,
    /// Version of that image.
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

/// Reads the device's event log, the newest entry first.
///
/// # Errors
/// The errors of a [read](Session::read). A device without support for sealed images does not have
/// this object.
pub fn events(session: &mut Session<'_>) -> Result<Vec<Event>, Error> {
    let mut events = Vec::new();
    for place in 1..=seal::access::EVENTS as u8 {
        let at = Address::new(EVENTS, place);
        let bytes: [u8; 16] = session.read(at)?.try_into().map_err(|_| Error::wrong_length(at))?;
        let [number, what, counter, version] = [0, 4, 8, 12].map(|at| word(&bytes, at));
        if number > 0 {
            events.push(Event { number, what, counter, version });
        }
    }
    Ok(events)
}
