//! A check, and its verdict.

use super::bench::{Bench, Stop};

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
    /// Whether a program is erased or installed.
    pub installs: bool,
    /// What the device must have or be; otherwise the check is skipped.
    needs: Option<Step>,
    run: Run,
}

/// A part of a check.
pub(super) type Step = fn(&mut Bench<'_>) -> Result<(), Stop>;

/// What a check does.
#[derive(Clone, Copy, Debug)]
pub(super) enum Run {
    By(Step),
    /// This SDO request is refused with this abort code.
    Refused([u8; 8], u32),
    /// An object is read by expedited upload: index, sub-index and number of bytes.
    Number(u16, u8, u8),
}

impl Check {
    pub(super) const fn of(id: &'static str, title: &'static str, clause: &'static str, run: Run) -> Self {
        Self { id, title, clause, resets: false, installs: false, needs: None, run }
    }

    pub(super) const fn new(id: &'static str, title: &'static str, clause: &'static str, run: Step) -> Self {
        Self::of(id, title, clause, Run::By(run))
    }

    pub(super) const fn that_resets(self) -> Self {
        Self { resets: true, ..self }
    }

    pub(super) const fn that_installs(self) -> Self {
        Self { installs: true, ..self }
    }

    pub(super) const fn needs(self, needs: Step) -> Self {
        Self { needs: Some(needs), ..self }
    }

    pub(super) fn judge(&self, bench: &mut Bench<'_>) -> Result<(), Stop> {
        if let Some(needs) = self.needs {
            needs(bench)?;
        }
        match self.run {
            Run::By(step) => step(bench),
            Run::Refused(request, code) => bench.refuses(request, code),
            Run::Number(index, sub, len) => bench.value(index, sub, len).map(drop),
        }
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
