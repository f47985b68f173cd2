//! Lists the adapters of this computer.

use std::time::Duration;

use super::drivers::driver;
use super::found::{Found, Kind, Missing};
use super::in_time::in_time;
#[cfg(target_os = "linux")]
use super::links;
use super::{beacons, ports};

/// The result of a search.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct List {
    /// The adapters.
    pub found: Vec<Found>,
    /// The kinds for which the search failed.
    pub missing: Vec<(Kind, Missing)>,
}

impl List {
    /// The adapter to use if the user has named none: the only certain one, if there is exactly
    /// one.
    #[must_use]
    pub fn only(&self) -> Option<&Found> {
        let mut certain = self.found.iter().filter(|found| found.certain);
        certain.next().filter(|_| certain.next().is_none())
    }
}

/// How long the search for one kind may take, in addition to the time for listening.
const LIMIT: Duration = Duration::from_secs(5);
/// More adapters of one kind than any computer has. A longer list is wrong.
const MOST: usize = 100;

/// Searches for adapters of these kinds. Listens for beacons of socketcand servers, which come
/// every 3 s, during `listen`. Always returns: a search that takes longer than 5 s is given up.
#[must_use]
pub fn list(kinds: &[Kind], listen: Duration) -> List {
    let mut list = List::default();
    for kind in Kind::ALL.into_iter().filter(|kind| kinds.contains(kind)) {
        let limit = if kind == Kind::Socketcand { LIMIT + listen } else { LIMIT };
        match in_time(limit, move || search(kind, listen)) {
            Some(Ok(found)) => list.found.extend(found.into_iter().take(MOST)),
            Some(Err(missing)) => list.missing.push((kind, missing)),
            None => {
                let what = format!("the search did not end within {} s", limit.as_secs());
                let advice = "unplug these adapters and plug them in again, or install their driver anew";
                list.missing.push((kind, Missing { what, advice }));
            }
        }
    }
    list
}

fn search(kind: Kind, listen: Duration) -> Result<Vec<Found>, Missing> {
    match kind {
        Kind::Serial => ports::list(),
        #[cfg(target_os = "linux")]
        Kind::SocketCan => links::list(),
        #[cfg(not(target_os = "linux"))]
        Kind::SocketCan => Ok(Vec::new()),
        Kind::Socketcand => beacons::list(listen),
        Kind::Peak | Kind::Kvaser | Kind::GsUsb => match driver(kind) {
            Ok(driver) => (driver.list)(),
            Err(what) => Err(Missing { what, advice: "build it with all features" }),
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_only_one_is_one_that_surely_leads_to_a_bus() {
        let found = |url: &str, about: &str| Found::new(Kind::Kvaser, url.to_string(), about.to_string());
        let list = |found: &[Found]| List { found: found.to_vec(), missing: Vec::new() };
        let leaf = found("kvaser:0", "Kvaser Leaf Light v2");
        let virtual_one = found("kvaser:1", "Kvaser Virtual CAN Driver");
        assert_eq!(list(&[]).only(), None);
        assert_eq!(list(std::slice::from_ref(&virtual_one)).only(), None);
        assert_eq!(list(&[virtual_one, leaf.clone()]).only(), Some(&leaf));
        assert_eq!(list(&[leaf.clone(), leaf]).only(), None);
    }
}
