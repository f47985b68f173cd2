//! The reports to the owner about accesses of a program that are wrong or not modelled.

use crate::time::Time;

/// What kind of access a report is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Access {
    /// A load.
    Read,
    /// A store.
    Write,
    /// An instruction fetch.
    Fetch,
}

impl std::fmt::Display for Access {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Read => "read",
            Self::Write => "write",
            Self::Fetch => "fetch",
        })
    }
}

/// An access that the model does not cover, or that the chip would punish or ignore. Each pair of
/// address and program counter is reported once, with a count.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Report {
    /// The time of the first occurrence.
    pub time: Time,
    /// The address accessed.
    pub address: u32,
    /// The instruction that did it, or the first one of its straight run of code where the
    /// instruction itself cannot be determined.
    pub pc: u32,
    /// Bytes accessed.
    pub size: u8,
    /// Load, store or fetch.
    pub access: Access,
    /// What a store wrote, at the first time.
    pub value: u32,
    /// The fault, in words.
    pub what: String,
    /// How often it happened.
    pub count: u64,
}

impl Report {
    /// The access and its fault, without time and count.
    #[must_use]
    pub fn words(&self) -> String {
        let Self { access, size, address, pc, what, .. } = self;
        let value = if *access == Access::Write { format!(" = {:X}h", self.value) } else { String::new() };
        format!("{access} of {size} bytes at {address:08X}h{value}, pc {pc:08X}h: {what}")
    }
}

impl std::fmt::Display for Report {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}: {}", self.time, self.words())?;
        match self.count {
            0 | 1 => Ok(()),
            count => write!(f, " ({count} times)"),
        }
    }
}

/// The most reports that are kept: a program that runs wild must not fill the host's memory.
const MOST: usize = 1_000;

/// The reports of one machine.
#[derive(Clone, Debug, Default)]
pub struct Reports {
    list: Vec<Report>,
}

impl Reports {
    /// Adds one, or counts up the one there is for the same address, program counter and access.
    pub fn add(&mut self, report: Report) {
        let same = |r: &Report| r.address == report.address && r.pc == report.pc && r.access == report.access;
        match self.list.iter().position(same) {
            Some(known) => self.list[known].count += 1,
            None if self.list.len() < MOST => self.list.push(report),
            None => {}
        }
    }

    /// All of them, in the order in which they first happened.
    #[must_use]
    pub fn as_slice(&self) -> &[Report] {
        &self.list
    }
}
