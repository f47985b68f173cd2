//! Conformance checks for a device on a real bus (`coflash conform`).
//!
//! A check is data (its number, the clause, what is expected) and a function over a [`Bench`]. All
//! checks here leave the device's program alone. Those that reset the device say so
//! ([`Check::resets`]) and run only if they are asked for.
//!
//! | module | what it does |
//! |---|---|
//! | `bench` | frames to and from the device, with time limits on the adapter's clock |
//! | `sdo` | checks of the SDO server and of the mandatory objects |
//! | `frames` | wrong frames |
//! | `network` | boot-up, heartbeat, NMT and LSS |
//! | `junit` | the report for a test system |

mod bench;
mod frames;
mod junit;
mod network;
mod sdo;

use std::sync::atomic::AtomicBool;
use std::sync::Arc;
use std::time::Duration;

use canopen::NodeId;

use self::bench::Bench;
pub use self::bench::Stop;
pub use self::junit::junit;
use crate::bus::Adapter;
use crate::device::Error;

/// A check of one property of the device.
#[derive(Clone, Copy, Debug)]
pub struct Check {
    /// The stable number, as in `SDO-012`; the part before the dash is the group.
    pub id: &'static str,
    /// What is sent, and what is expected.
    pub title: &'static str,
    /// The document and its clause.
    pub clause: &'static str,
    /// Whether the device is reset: a bootloader with a program may then start it.
    pub resets: bool,
    run: fn(&mut Bench<'_>) -> Result<(), Stop>,
}

impl Check {
    const fn new(
        id: &'static str,
        title: &'static str,
        clause: &'static str,
        run: fn(&mut Bench<'_>) -> Result<(), Stop>,
    ) -> Self {
        Self { id, title, clause, resets: false, run }
    }

    const fn that_resets(self) -> Self {
        Self { resets: true, ..self }
    }

    /// The group of the check, as in `SDO`.
    #[must_use]
    pub fn group(&self) -> &'static str {
        self.id.split('-').next().unwrap_or(self.id)
    }

    /// Whether `word` names this check or its group, in upper or lower case.
    #[must_use]
    pub fn is_named(&self, word: &str) -> bool {
        self.id.eq_ignore_ascii_case(word) || self.group().eq_ignore_ascii_case(word)
    }
}

/// The outcome of a check.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// The device does what the clause asks for.
    Passed,
    /// The device does something else: what.
    Failed(String),
    /// The property cannot be judged on this device or this host: why.
    Skipped(String),
}

/// A check with its outcome.
#[derive(Clone, Debug)]
pub struct Verdict {
    /// The check.
    pub check: Check,
    /// The outcome.
    pub outcome: Outcome,
}

/// All checks, in the order in which they run.
#[must_use]
pub fn checks() -> Vec<Check> {
    [network::CHECKS, sdo::CHECKS, frames::CHECKS].concat()
}

/// Runs checks on a device and passes each verdict to `tell`. `answer` is the longest time for an
/// answer of the device. Before each check, the device is put into pre-operational state, and a
/// transfer that is left over is aborted; the device is left like this.
///
/// # Errors
/// [`Error::Adapter`] if the bus is lost; [`Error::Cancelled`].
pub fn run(
    adapter: &mut dyn Adapter,
    node: NodeId,
    checks: &[Check],
    answer: Duration,
    cancelled: &Arc<AtomicBool>,
    tell: &mut dyn FnMut(&Verdict),
) -> Result<Vec<Verdict>, Error> {
    let mut bench = Bench::new(adapter, node, answer, cancelled);
    let mut verdicts = Vec::new();
    for check in checks {
        bench.settle()?;
        let outcome = match (check.run)(&mut bench) {
            Ok(()) => Outcome::Passed,
            Err(Stop::Failed(what)) => Outcome::Failed(what),
            Err(Stop::Skipped(why)) => Outcome::Skipped(why),
            Err(Stop::Bus(error)) => {
                // The reason why the checks end stays the error.
                let _ = bench.settle();
                return Err(error);
            }
        };
        let verdict = Verdict { check: *check, outcome };
        tell(&verdict);
        verdicts.push(verdict);
    }
    bench.settle()?;
    Ok(verdicts)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_check_has_a_number_of_its_own_and_a_clause() {
        let mut ids: Vec<_> = checks().iter().map(|check| check.id).collect();
        let count = ids.len();
        ids.sort_unstable();
        ids.dedup();
        assert_eq!(ids.len(), count);
        assert!(checks().iter().all(|check| check.clause.starts_with("CiA ") && check.id.contains('-')));
    }
}
