//! The data of 1F50h: turns the bytes of an SDO transfer into checked pieces with addresses.
//!
//! | format | recognised by |
//! |---|---|
//! | [`block_file`] | the number of a block |
//! | [`ihex`] | `:` |
//! | [`sealed`] | `CBS1`, in a device that takes sealed images |
//! | [`raw`] | an initial stack pointer; any bytes if the program is data |
//!
//! A format gets its bytes, the rules ([`Judge`]) and the queue for the pieces. It has no access to
//! the flash. It reports its results in a [`Findings`]. To add a format, add a file with an
//! implementation of [`Format`] and a line in the list below.

mod block_file;
mod format;
mod ihex;
mod raw;
mod sealed;
mod stream;

use canopen::program::FlashError;
use canopen::AbortCode;

use crate::choices::Choices;
use crate::policy::Judge;
use crate::queue::Queue;
use crate::refusal::Refusal;
pub(crate) use format::{Destination, Findings, Format, Recognition};

formats! {
    Sealed(sealed::SealedImage),
    BlockFile(block_file::BlockFile),
    IntelHex(ihex::IntelHex),
    Raw(raw::Raw),
}

/// This many bytes identify every format.
const FIRST: usize = 4;

/// One transfer.
pub(crate) struct Intake {
    size: Option<u32>,
    state: State,
}

enum State {
    /// Too few bytes have arrived to identify the format.
    Unknown {
        bytes: [u8; FIRST],
        len: usize,
    },
    Known(Known),
}

impl Intake {
    /// A transfer, with its size if the client announced it.
    pub(crate) const fn new(size: Option<u32>) -> Self {
        Self { size, state: State::Unknown { bytes: [0; FIRST], len: 0 } }
    }

    /// Takes the next bytes.
    pub(crate) fn data<C: Choices>(
        &mut self,
        mut bytes: &[u8],
        to: &mut Destination<'_, '_>,
    ) -> Result<(), Refusal> {
        if let State::Unknown { bytes: first, len } = &mut self.state {
            let more = bytes.len().min(FIRST - *len);
            first[*len..*len + more].copy_from_slice(&bytes[..more]);
            *len += more;
            bytes = &bytes[more..];
            let (first, len) = (*first, *len);
            let Some(mut known) = Known::recognise::<C>(&first[..len], &to.judge)? else { return Ok(()) };
            if to.judge.images.only_sealed().is_some()
                && !matches!(known, Known::Sealed(_) | Known::BlockFile(_))
            {
                return Err(Refusal::unfit(FlashError::NoAccess));
            }
            known.begin(self.size, &to.judge, to.queue)?;
            known.data::<C>(&first[..len], to)?;
            self.state = State::Known(known);
        }
        match &mut self.state {
            State::Known(known) if !bytes.is_empty() => known.data::<C>(bytes, to),
            _ => Ok(()),
        }
    }

    /// The client has sent all data.
    pub(crate) fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        match &mut self.state {
            State::Known(known) => known.end(to),
            State::Unknown { .. } => Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_LOW)),
        }
    }

    /// Whether the transfer is a whole program, or may turn out to be one.
    pub(crate) fn may_be_stream(&self) -> bool {
        match &self.state {
            State::Known(known) => known.is_stream(),
            State::Unknown { .. } => true,
        }
    }

    /// Whether the transfer is a whole program.
    pub(crate) fn is_stream(&self) -> bool {
        matches!(&self.state, State::Known(known) if known.is_stream())
    }

    /// The number of bytes that it accepts at present. There is room for a block before it begins,
    /// so this only concerns streams. With `held`, the answer to the client is already delayed, see
    /// [`stream::room`].
    pub(crate) fn room(&self, queue: &Queue<'_>, held: bool) -> usize {
        if self.may_be_stream() {
            stream::room(queue, held)
        } else {
            usize::MAX
        }
    }
}

/// Makes [`Known`], the transfer with a known format, from the list of the formats.
macro_rules! formats {
    ($($name:ident($format:ty)),* $(,)?) => {
        enum Known {
            $($name($format)),*
        }

        impl Known {
            /// `None` if there are too few bytes to decide: the first format of the list that may have them counts.
            fn recognise<C: Choices>(first: &[u8], judge: &Judge<'_>) -> Result<Option<Self>, Refusal> {
                let mut more = false;
                $(match <$format>::recognise(first, judge) {
                    Recognition::Yes(format) if !more && <$format>::is_taken::<C>() => return Ok(Some(Self::$name(format))),
                    Recognition::More => more = true,
                    Recognition::Yes(_) | Recognition::No => {}
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

            fn data<C: Choices>(
                &mut self,
                bytes: &[u8],
                to: &mut Destination<'_, '_>,
            ) -> Result<(), Refusal> {
                match self {
                    $(Self::$name(format) if <$format>::is_taken::<C>() => format.data(bytes, to),)*
                    _ => Err(to.judge.unknown_format()),
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
