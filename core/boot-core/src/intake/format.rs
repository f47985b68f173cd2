//! What each format implements, and what it gets and reports.

use crate::choices::Choices;
use crate::keys::Linked;
use crate::policy::Judge;
use crate::queue::Queue;
use crate::refusal::Refusal;
use crate::resume::Partial;

/// At least the first two vectors: a program whose CRC does not cover them cannot start.
pub(crate) const SMALLEST_PROGRAM: u32 = 8;

/// The result of looking at the first bytes.
pub(crate) enum Recognition<T> {
    /// The bytes are not in this format.
    No,
    /// There are too few bytes to decide.
    More,
    /// The bytes are in this format.
    Yes(T),
}

/// A format of programs.
pub(crate) trait Format: Sized {
    /// Whether it carries a whole program in one transfer. Such a client is slowed down if the
    /// flash is slower than the bus, and an aborted transfer leaves an incomplete program.
    const IS_STREAM: bool;

    /// Whether the device takes the format. Without it, the compiler leaves out the code.
    fn is_taken<C: Choices>() -> bool {
        true
    }

    /// Looks at the first bytes of a transfer, at most four.
    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self>;

    /// The transfer begins, with this size if the client announced it.
    fn begin(&mut self, size: Option<u32>, judge: &Judge<'_>, queue: &Queue<'_>) -> Result<(), Refusal>;

    /// Takes the next bytes.
    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal>;

    /// The client has sent all data.
    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal>;
}

/// The destination of a format's pieces, and the rules for them.
pub(crate) struct Destination<'a, 'b> {
    /// The rules.
    pub judge: Judge<'a>,
    /// The pieces.
    pub queue: &'a mut Queue<'b>,
    /// The results so far.
    pub findings: Findings,
}

/// The results of the bytes of a transfer.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Findings {
    /// The download begins: the data so far are for this device.
    pub begins: Option<Begin>,
    /// A block of data joined the queue.
    pub block: bool,
    /// The program is complete.
    pub complete: Option<crate::program::Expected>,
    /// The download is a sealed image.
    pub sealed: Option<Linked>,
}

/// What is known about a program when its download begins.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Begin {
    /// Size of the program in bytes, 0 if unknown: its flash may be erased up to this size before
    /// data arrive.
    pub size: u32,
    /// Its version, 0 if unknown.
    pub version: u32,
    /// Its creation date in seconds since 1970-01-01 UTC, 0 if unknown.
    pub date: u32,
    /// Its progress: at its start, with the identity of its block file.
    pub partial: Partial,
}
