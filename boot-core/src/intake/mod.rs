//! What arrives in 1F50h: the bytes of an SDO transfer become pieces, judged and placed.
//!
//! | format | told by |
//! |---|---|
//! | [`block_file`] | the number of a block |
//! | [`ihex`] | `:` |
//! | `sealed` | `CBS1` (feature `sealed`) |
//! | [`raw`] | an initial stack pointer; any bytes where the program is data |
//!
//! A format sees its bytes, the rules that it is judged by ([`Judge`]) and the queue of the pieces.
//! It cannot reach the flash. What its bytes lead to it leaves in a [`Progress`]. A new format is a
//! file with an implementation of [`Format`], and a line in the list below.

mod block_file;
mod ihex;
mod judge;
mod raw;
#[cfg(feature = "sealed")]
mod sealed;
mod stream;

use canopen::program::FlashError;
use canopen::AbortCode;

use crate::queue::Queue;
use crate::refusal::Refusal;
pub(crate) use judge::Judge;

#[cfg(not(feature = "sealed"))]
formats! {
    BlockFile(block_file::BlockFile),
    IntelHex(ihex::IntelHex),
    Raw(raw::Raw),
}
#[cfg(feature = "sealed")]
formats! {
    Sealed(sealed::Sealed),
    BlockFile(block_file::BlockFile),
    IntelHex(ihex::IntelHex),
    Raw(raw::Raw),
}

/// The first two vectors at least: a program without them under its CRC cannot be started.
pub(crate) const SMALLEST_PROGRAM: u32 = 8;

/// Bytes that tell every format.
const FIRST: usize = 4;

/// What a format makes of its first bytes.
pub(crate) enum Recognition<T> {
    /// They are not in this format.
    No,
    /// There are too few to tell.
    More,
    /// They are.
    Yes(T),
}

/// A form in which programs come.
pub(crate) trait Format: Sized {
    /// Whether it brings a whole program in one transfer. Such a client is slowed down when the
    /// flash is slower than the bus, and half a program is left when its transfer breaks off.
    const IS_STREAM: bool;

    /// Looks at the first bytes of a transfer, up to four.
    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self>;

    /// The transfer begins, with this many bytes where the client told.
    fn begin(&mut self, size: Option<u32>, judge: &Judge<'_>, queue: &Queue<'_>) -> Result<(), Refusal>;

    /// Takes the next bytes.
    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal>;

    /// The client has sent all.
    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal>;
}

/// Where a format's pieces go, and who judges them.
pub(crate) struct Destination<'a, 'b> {
    /// The rules.
    pub judge: Judge<'a>,
    /// The pieces.
    pub queue: &'a mut Queue<'b>,
    /// What the bytes have led to.
    pub progress: Progress,
}

/// What the bytes of a transfer have led to.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Progress {
    /// The download begins: what came so far is for this device.
    pub begins: Option<Begin>,
    /// A block of data joined the queue.
    pub block: bool,
    /// The program is complete.
    pub complete: Option<crate::program::Expected>,
    /// What begins is a sealed image.
    #[cfg(feature = "sealed")]
    pub sealed: bool,
}

/// What is known of a program when its download begins.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Begin {
    /// Bytes of the program, 0 where that is not known: its flash may be erased that far before
    /// there are data.
    pub size: u32,
    /// Its version, 0 where that is not known.
    pub version: u32,
}

/// One transfer.
pub(crate) struct Intake {
    size: Option<u32>,
    state: State,
}

enum State {
    /// Too few bytes came to tell the format.
    Unknown {
        bytes: [u8; FIRST],
        len: usize,
    },
    Known(Known),
}

impl Intake {
    /// A transfer, with this many bytes where the client told.
    pub(crate) const fn new(size: Option<u32>) -> Self {
        Self { size, state: State::Unknown { bytes: [0; FIRST], len: 0 } }
    }

    /// Takes the next bytes.
    pub(crate) fn data(&mut self, mut bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if let State::Unknown { bytes: first, len } = &mut self.state {
            let more = bytes.len().min(FIRST - *len);
            first[*len..*len + more].copy_from_slice(&bytes[..more]);
            *len += more;
            bytes = &bytes[more..];
            let (first, len) = (*first, *len);
            let Some(mut known) = Known::recognise(&first[..len], &to.judge)? else { return Ok(()) };
            #[cfg(feature = "sealed")]
            if to.judge.sealed_only && !matches!(known, Known::Sealed(_) | Known::BlockFile(_)) {
                return Err(Refusal::unfit(FlashError::NoAccess));
            }
            known.begin(self.size, &to.judge, to.queue)?;
            known.data(&first[..len], to)?;
            self.state = State::Known(known);
        }
        match &mut self.state {
            State::Known(known) if !bytes.is_empty() => known.data(bytes, to),
            _ => Ok(()),
        }
    }

    /// The client has sent all.
    pub(crate) fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        match &mut self.state {
            State::Known(known) => known.end(to),
            State::Unknown { .. } => Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)),
        }
    }

    /// Whether what was told is a whole program in one transfer, or may turn out to be.
    pub(crate) fn may_be_stream(&self) -> bool {
        match &self.state {
            State::Known(known) => known.is_stream(),
            State::Unknown { .. } => true,
        }
    }

    /// Whether it is a whole program in one transfer.
    pub(crate) fn is_stream(&self) -> bool {
        matches!(&self.state, State::Known(known) if known.is_stream())
    }

    /// Bytes that it takes at present. Blocks have their room before they begin, so this is about
    /// streams; `held` for a client whose answer is already being held back, see
    /// [`stream::room`].
    pub(crate) fn room(&self, queue: &Queue<'_>, held: bool) -> usize {
        if self.may_be_stream() {
            stream::room(queue, held)
        } else {
            usize::MAX
        }
    }
}

/// Makes [`Known`], the transfer whose format is known, of the list of the formats.
macro_rules! formats {
    ($($name:ident($format:ty)),* $(,)?) => {
        enum Known {
            $($name($format)),*
        }

        impl Known {
            /// `None` while there are too few bytes to tell.
            fn recognise(first: &[u8], judge: &Judge<'_>) -> Result<Option<Self>, Refusal> {
                let mut more = false;
                $(match <$format>::recognise(first, judge) {
                    Recognition::Yes(format) => return Ok(Some(Self::$name(format))),
                    Recognition::More => more = true,
                    Recognition::No => {}
                })*
                if more { Ok(None) } else { Err(judge.unknown_format()) }
            }

            fn is_stream(&self) -> bool {
                match self {
                    $(Self::$name(_) => <$format>::IS_STREAM),*
                }
            }

            fn begin(
                &mut self,
                size: Option<u32>,
                judge: &Judge<'_>,
                queue: &Queue<'_>,
            ) -> Result<(), Refusal> {
                match self {
                    $(Self::$name(format) => format.begin(size, judge, queue)),*
                }
            }

            fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
                match self {
                    $(Self::$name(format) => format.data(bytes, to)),*
                }
            }

            fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
                match self {
                    $(Self::$name(format) => format.end(to)),*
                }
            }
        }
    };
}
use formats;
