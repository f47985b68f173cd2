//! Chooses the adapter if no `--bus` is given.

use std::fmt;
use std::time::Duration;

use coboot_can::{list, Found, Kind, URLS};

use super::output::{Failure, Output};

/// The value of `--search`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Kinds(pub(super) Vec<Kind>);

impl Kinds {
    /// `serial,peak`, or `none`.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        if text == "none" {
            return Ok(Self::default());
        }
        let kind = |word: &str| {
            Kind::ALL.into_iter().find(|kind| kind.name() == word.trim()).ok_or_else(|| {
                format!("kinds of adapters are {}, or none", Kind::ALL.map(Kind::name).join(", "))
            })
        };
        text.split(',').map(kind).collect::<Result<_, _>>().map(Self)
    }
}

/// The URL of the only adapter.
pub(super) fn only(out: Output, kinds: &[Kind]) -> Result<String, Failure> {
    // The tool never chooses a server on the network by itself, so it need not wait for beacons.
    let kinds: Vec<Kind> = kinds.iter().copied().filter(|kind| *kind != Kind::Socketcand).collect();
    let list = list(&kinds, Duration::ZERO);
    if let Some(only) = list.only() {
        out.note(format_args!("no --bus is given: using the only adapter, {}", Line(only)));
        return Ok(only.url.clone());
    }
    let unsaid = "no CAN bus is given";
    let lines = |certain: bool| {
        let found = list.found.iter().filter(|found| found.certain == certain);
        found.map(|found| Line(found).to_string()).collect::<Vec<_>>()
    };
    let (certain, others) = (lines(true), lines(false));
    Err(match (certain.as_slice(), others.as_slice()) {
            ([], []) => Failure::usage(
                format!("{unsaid}, and no adapter was found"),
                format!(
                    "plug the adapter in (coflash adapters lists the adapters of this computer and servers on the network), or give \
                     --bus URL or set COFLASH_BUS; known are {URLS}"
                ),
            ),
            ([], others) => Failure::usage(
                unsaid,
                format!("give --bus URL; possible adapters are: {}", others.join(", ")),
            ),
            (several, _) => Failure::usage(
                format!("{unsaid}, and this computer has several adapters"),
                format!("give one of them with --bus: {}", several.join(", ")),
            ),
        })
}

/// An adapter in one line.
struct Line<'f>(&'f Found);

impl fmt::Display for Line<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Found { url, about, state, bit_rate, .. } = self.0;
        let rate = bit_rate.map(|rate| format!("{} kbit/s", f64::from(rate) / 1000.0));
        let state = state.map(|state| state.words().to_string());
        let words = [Some(about.clone()).filter(|about| !about.is_empty()), rate, state];
        let words: Vec<String> = words.into_iter().flatten().collect();
        match words.as_slice() {
            [] => f.write_str(url),
            words => write!(f, "{url} ({})", words.join(", ")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_are_a_list_or_none() {
        assert_eq!(Kinds::parse("none"), Ok(Kinds(Vec::new())));
        assert_eq!(Kinds::parse("peak, serial"), Ok(Kinds(vec![Kind::Peak, Kind::Serial])));
        for text in ["", "usb", "peak,", "peak,none"] {
            assert!(Kinds::parse(text).is_err(), "{text}");
        }
    }
}
