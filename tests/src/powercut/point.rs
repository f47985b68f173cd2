//! The names of points, as `update:37:torn` or `update:37:torn:12:after`: what both levels share.

use std::fmt;

/// One cut: the number of the flash operation, and the way as an index of the level's ways.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct At {
    pub operation: u32,
    pub kind: usize,
}

/// Writes a scenario and its cuts.
pub fn write(
    f: &mut fmt::Formatter<'_>,
    scenario: &str,
    cuts: [Option<At>; 2],
    way: impl Fn(usize) -> &'static str,
) -> fmt::Result {
    f.write_str(scenario)?;
    cuts.into_iter().flatten().try_for_each(|at| write!(f, ":{}:{}", at.operation, way(at.kind)))
}

/// Reads what [`write`] writes.
///
/// # Errors
/// What is wrong, and what there is.
pub fn read<'t>(
    mut words: impl Iterator<Item = &'t str>,
    scenarios: &[&'static str],
    ways: &[&str],
) -> Result<(&'static str, At, Option<At>), String> {
    let name = words.next().unwrap_or_default();
    let scenario = scenarios.iter().find(|known| **known == name);
    let scenario =
        scenario.ok_or_else(|| format!("{name:?} is no scenario; there are {}.", scenarios.join(", ")))?;
    let mut at = || -> Result<Option<At>, String> {
        let Some(operation) = words.next() else { return Ok(None) };
        let operation =
            operation.parse().map_err(|_| format!("{operation:?} is no number of an operation."))?;
        let way = words.next().unwrap_or_default();
        let kind = ways.iter().position(|known| *known == way);
        let kind = kind.ok_or_else(|| format!("{way:?} is no way to cut; there are {}.", ways.join(", ")))?;
        Ok(Some(At { operation, kind }))
    };
    let first = at()?.ok_or("a point names an operation: update:37:torn.")?;
    let second = at()?;
    match words.next() {
        None => Ok((scenario, first, second)),
        Some(more) => Err(format!("{more:?}: a point has two cuts at most.")),
    }
}
