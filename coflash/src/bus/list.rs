//! Which adapters are there.

use std::time::Duration;

use super::found::{Found, Kind, Missing};
#[cfg(feature = "gs_usb")]
use super::gs_usb;
use super::in_time::in_time;
#[cfg(feature = "kvaser")]
use super::kvaser;
#[cfg(target_os = "linux")]
use super::links;
#[cfg(feature = "peak")]
use super::peak;
use super::{beacons, ports};

/// What was found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct List {
    /// The adapters.
    pub found: Vec<Found>,
    /// The kinds that could not be looked for.
    pub missing: Vec<(Kind, Missing)>,
}

impl List {
    /// The only adapter that may be taken unasked, if there is exactly one.
    #[must_use]
    pub fn only(&self) -> Option<&Found> {
        let mut certain = self.found.iter().filter(|found| found.certain);
        certain.next().filter(|_| certain.next().is_none())
    }
}

/// How long a kind may take, besides the time that it is given to listen.
const LIMIT: Duration = Duration::from_secs(5);
/// More adapters of a kind than anybody has: what goes beyond is a lie.
const MOST: usize = 100;

/// Looks for adapters of these kinds. Beacons of socketcand are listened for during `listen`; its
/// servers send one every 3 s. Returns in any case: a kind that does not come to an end within 5 s is
/// given up.
#[must_use]
pub fn list(kinds: &[Kind], listen: Duration) -> List {
    let mut list = List::default();
    for kind in Kind::ALL.into_iter().filter(|kind| kinds.contains(kind)) {
        let limit = if kind == Kind::Socketcand { LIMIT + listen } else { LIMIT };
        match in_time(limit, move || search(kind, listen)) {
            Some(Ok(found)) => list.found.extend(found.into_iter().take(MOST)),
            Some(Err(missing)) => list.missing.push((kind, missing)),
            None => {
                let what = format!("the search did not come to an end within {} s", limit.as_secs());
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
        #[cfg(feature = "peak")]
        Kind::Peak => peak::list(),
        #[cfg(feature = "kvaser")]
        Kind::Kvaser => kvaser::list(),
        #[cfg(feature = "gs_usb")]
        Kind::GsUsb => gs_usb::list().map_err(|what| Missing {
            what: format!("the USB devices cannot be listed: {what}"),
            advice: "check that this computer has USB",
        }),
        Kind::Socketcand => beacons::list(listen),
        #[allow(unreachable_patterns)]
        kind => Err(Missing {
            what: format!("this coflash was built without {kind}"),
            advice: "build it with all features",
        }),
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
