//! Conformance checks for a device on a real bus (`coflash more conform`).
//!
//! A check is data (its number, the clause, what is expected) and a function over a bench. Those
//! that reset the device ([`Check::resets`]) or install a program ([`Check::installs`]) say so; the
//! others leave the program alone.
//!
//! | module | what it does |
//! |---|---|
//! | `bench` | frames to and from the device, with time limits on the adapter's clock |
//! | `objects` | the objects that describe the device, and emergencies |
//! | `check` | a check, and its verdict |
//! | `sdo` | the SDO server: refusals, expedited and segmented transfers |
//! | `block` | SDO block upload |
//! | `frames` | wrong frames |
//! | `network` | boot-up, heartbeat and NMT |
//! | `lss` | layer setting services |
//! | `program` | 1F50h to 1F57h, without a change of the program |
//! | `renewal` | the bootloader's own number in 1F50h to 1F57h, without a renewal |
//! | `update` | updates, whole and interrupted, with a program that the user gives |
//! | `junit` | the report for a test system |
#![forbid(unsafe_code)]

mod bench;
mod block;
mod check;
mod frames;
mod junit;
mod lss;
mod network;
mod objects;
mod program;
mod renewal;
mod sdo;
mod update;

use std::sync::atomic::AtomicBool;
use std::sync::Arc;

use canopen::NodeId;

use self::bench::Bench;
pub use self::bench::{Means, Power, Stop};
pub use self::check::{Check, Outcome, Verdict};
pub use self::junit::junit;
use coboot_can::Adapter;
use coflash_core::device::Error;

/// All checks, in the order in which they run.
#[must_use]
pub fn checks() -> Vec<Check> {
    [
        network::CHECKS,
        objects::CHECKS,
        sdo::CHECKS,
        block::CHECKS,
        frames::CHECKS,
        lss::CHECKS,
        program::CHECKS,
        renewal::CHECKS,
        update::CHECKS,
    ]
    .concat()
}

/// Runs checks on a device and passes each verdict to `report`. Before each check, the device is put
/// into pre-operational state, and a transfer that is left over is aborted. At the end, also after
/// an error, the device gets back the NMT state that its heartbeat reported before the first check;
/// without a heartbeat it stays pre-operational.
///
/// # Errors
/// [`Error::Adapter`] if the bus is lost; [`Error::Cancelled`].
pub fn run(
    adapter: &mut dyn Adapter,
    node: NodeId,
    checks: &[Check],
    means: Means<'_>,
    cancelled: &Arc<AtomicBool>,
    report: &mut dyn FnMut(&Verdict),
) -> Result<Vec<Verdict>, Error> {
    let mut bench = Bench::new(adapter, node, means, cancelled);
    let found = match bench.state() {
        Ok(found) => found,
        Err(Stop::Bus(error)) => return Err(error),
        Err(_) => None,
    };
    let verdicts = run_all(&mut bench, checks, report);
    let left = bench.leave(found);
    // The reason why the checks ended stays the error.
    let verdicts = verdicts?;
    left.map(|()| verdicts)
}

fn run_all(
    bench: &mut Bench<'_>,
    checks: &[Check],
    report: &mut dyn FnMut(&Verdict),
) -> Result<Vec<Verdict>, Error> {
    let mut verdicts = Vec::new();
    for check in checks {
        bench.settle()?;
        let outcome = match check.judge(bench) {
            Ok(()) => Outcome::Passed,
            Err(Stop::Failed(what)) => Outcome::Failed(what),
            Err(Stop::Skipped(why)) => Outcome::Skipped(why),
            Err(Stop::Bus(error)) => return Err(error),
        };
        let verdict = Verdict { check: *check, outcome };
        report(&verdict);
        verdicts.push(verdict);
    }
    Ok(verdicts)
}

/// The example on the crate's page compiles and runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;

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
        for check in checks() {
            let documents = ["CiA 301 4.2, ", "CiA 305, ", "L-1112, ", "coboot, "];
            assert!(documents.iter().any(|document| check.clause.starts_with(document)), "{check:?}");
            assert!(check.id.contains('-'), "{check:?}");
        }
    }
}
