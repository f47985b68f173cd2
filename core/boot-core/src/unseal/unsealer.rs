//! The interface to the processing of sealed images.

use canopen::program::FlashError;
use seal::wire::{flag, Fault, Head};
use shared_abi::date::of_control;

use super::buffers::{start, Buffers};
use super::image::{Image, Place, Progress};
use crate::flash::Flash;
use crate::keys::OfSealed;
use crate::program::Expected;
use crate::queue::{Piece, Queue};
use crate::store::Seal;
use crate::store::{Parameters, ProgramRecord, Value};

/// The processing of a sealed image, in a device that takes them.
pub(crate) struct Unsealer<'b>(OfSealed<'b, Workshop>);

/// Its state. A new one must consist of zeros, because it is in a static of the firmware: with any
/// other byte, all of it would be stored in flash, too. So the empty variant of its enums is the
/// first one, and `repr` keeps the compiler from another number for it; `None` has no such rule.
///
/// The small fields come first, within reach of short instructions.
#[repr(C)]
pub(crate) struct Workshop {
    work: Work,
    news: News,
    buffers: Buffers,
}

/// What is processed at present.
#[repr(u8)]
#[allow(clippy::large_enum_variant, reason = "there is one, and no heap: a smaller variant saves nothing")]
enum Work {
    /// Nothing.
    Idle,
    /// The signature of a request for rights is being checked; there is no image.
    Request(Request),
    Image(Image),
}

/// The rights that a client asks for, and their argument.
#[derive(Clone, Copy)]
pub(crate) struct Request {
    pub rights: u32,
    pub argument: u32,
}

/// What was found out, and is not yet known to others.
#[derive(Default)]
pub(crate) struct News {
    /// The manifest of an image is authentic, and the device has its keys.
    pub accepted: bool,
    /// How the work has ended.
    pub outcome: Outcome,
}

/// The end of the work on an image or a request.
#[derive(Default)]
#[repr(u8)]
pub(crate) enum Outcome {
    /// It has not ended.
    #[default]
    None,
    /// The signature of the request is good.
    Granted(Request),
    /// The image is installed; `same`: it was already installed before.
    Installed { program: u8, same: bool },
    /// The image was refused.
    Refused(FlashError),
}

/// Security counter and version of an image.
#[derive(Clone, Copy)]
pub(crate) struct Edition {
    pub counter: u32,
    pub version: u32,
}

impl Workshop {
    /// The state for one image at a time. All of it is zero.
    pub(crate) const fn new() -> Self {
        let news = News { accepted: false, outcome: Outcome::None };
        Self { work: Work::Idle, news, buffers: Buffers::new() }
    }
}

impl<'b> Unsealer<'b> {
    /// `None` in a device that takes no sealed images.
    pub(crate) fn new(workshop: Option<&'b mut Workshop>) -> Self {
        Self(OfSealed::new(workshop))
    }

    /// The image that is being processed.
    fn image(&self) -> Option<&Image> {
        match &self.0.get()?.work {
            Work::Image(image) => Some(image),
            Work::Idle | Work::Request(_) => None,
        }
    }

    /// See [`image`](Self::image).
    fn image_mut(&mut self) -> Option<&mut Image> {
        match &mut self.0.get_mut()?.work {
            Work::Image(image) => Some(image),
            Work::Idle | Work::Request(_) => None,
        }
    }

    /// Whether the device takes sealed images.
    pub(crate) fn is_present(&self) -> bool {
        self.0.get().is_some()
    }

    /// Whether the present download is a sealed image.
    pub(crate) fn is_active(&self) -> bool {
        self.image().is_some()
    }

    /// Starts an image.
    pub(crate) fn begin(&mut self, place: Place) {
        let Some(workshop) = self.0.get_mut() else { return };
        workshop.work = Work::Image(Image::new(place));
    }

    /// Starts to check the signature of a request for rights.
    pub(crate) fn check(
        &mut self,
        request: Request,
        key: &[u8; 32],
        signature: &[u8; 64],
        message: &[&[u8]],
    ) {
        let Some(workshop) = self.0.get_mut() else { return };
        start(&mut workshop.buffers.verification, key, signature, message);
        workshop.work = Work::Request(request);
    }

    /// Whether the signature of a request for rights is being checked.
    pub(crate) fn is_asked(&self) -> bool {
        self.0.get().is_some_and(|workshop| matches!(workshop.work, Work::Request(_)))
    }

    /// Ends the processing of an image, or of a request.
    pub(crate) fn cancel(&mut self) {
        if let Some(workshop) = self.0.get_mut() {
            workshop.cancel();
        }
    }

    /// The record of the image was stored, or could not be stored: ends its processing if the flash
    /// contains it.
    pub(crate) fn stored(&mut self, result: Result<(), FlashError>) {
        let Some(image) = self.image() else { return };
        let Progress::Installed { same } = image.progress() else { return };
        self.end(match result {
            Ok(()) => Outcome::Installed { program: image.program(), same: same.is_some() },
            Err(error) => Outcome::Refused(error),
        });
    }

    /// The work failed.
    pub(crate) fn fail(&mut self, error: FlashError) {
        if self.is_active() {
            self.end(Outcome::Refused(error));
        }
    }

    fn end(&mut self, outcome: Outcome) {
        let Some(workshop) = self.0.get_mut() else { return };
        workshop.news.outcome = outcome;
        workshop.cancel();
    }

    /// Returns what was found out since the last call.
    pub(crate) fn take_news(&mut self) -> News {
        self.0.get_mut().map(|workshop| core::mem::take(&mut workshop.news)).unwrap_or_default()
    }

    /// What there is to do with the image, if there is one.
    pub(crate) fn progress(&self) -> Option<Progress> {
        self.image().map(Image::progress)
    }

    /// Returns the new counter of an installed image, once.
    pub(crate) fn take_counter(&mut self) -> Option<Value> {
        self.image_mut()?.take_counter()
    }

    /// The next bytes for the flash.
    pub(crate) fn piece(&self) -> Option<Piece> {
        self.image()?.piece()
    }

    /// A byte of these bytes.
    pub(crate) fn data(&self, offset: usize) -> u8 {
        let at = self.image().map_or(0, Image::out) + offset;
        self.0.get().and_then(|workshop| workshop.buffers.bytes.get(at).copied()).unwrap_or(0)
    }

    /// These bytes are in flash.
    pub(crate) fn written(&mut self) {
        if let Some(image) = self.image_mut() {
            image.written();
        }
    }

    /// The head of the last image.
    fn head(&self) -> Option<Head<'_>> {
        self.0.get().map(|workshop| Head(&workshop.buffers.head))
    }

    /// The expected properties of the program.
    pub(crate) fn expected(&self) -> Expected {
        self.head().map_or(Expected { size: 0, crc: None }, |head| Expected {
            size: head.size(),
            crc: Some(head.crc()),
        })
    }

    /// Security counter and version of the last image.
    pub(crate) fn edition(&self) -> Edition {
        self.head().map_or(Edition { counter: 0, version: 0 }, |head| Edition {
            counter: head.counter(),
            version: head.version(),
        })
    }

    /// Marks the record of a program that was installed as a sealed image.
    pub(crate) fn mark(&self, record: ProgramRecord) -> ProgramRecord {
        let Some(head) = self.head().filter(|_| self.is_active()) else { return record };
        let writes = head.flags() & flag::WRITES_FLASH != 0;
        let seal = if writes { Seal::WritesFlash } else { Seal::Locked };
        ProgramRecord { version: head.version(), seal: Some(seal), ..record }
    }

    /// The creation date of a sealed image, in seconds since 1970-01-01 UTC; 0 if unknown.
    pub(crate) fn created(&self) -> u32 {
        self.head().filter(|_| self.is_active()).map_or(0, |head| of_control(head.created()))
    }

    /// Continues with one bounded step.
    pub(crate) fn step<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        queue: &mut Queue<'_>,
    ) -> Result<(), FlashError> {
        let Some(workshop) = self.0.get_mut() else { return Ok(()) };
        workshop
            .advance(flash, parameters, queue)
            .map_err(|fault| FlashError::from_code(fault as u8).unwrap_or(FlashError::Unspecified))
    }
}

impl Work {
    /// Whether a signature must be found good before it goes on.
    fn has_signature(&self) -> bool {
        match self {
            Self::Idle => false,
            Self::Request(_) => true,
            Self::Image(image) => image.has_signature(),
        }
    }
}

impl Workshop {
    /// Ends the work, and removes its secrets.
    fn cancel(&mut self) {
        if matches!(self.work, Work::Image(_)) {
            self.buffers.wipe();
        }
        self.work = Work::Idle;
    }

    fn advance<F: Flash>(
        &mut self,
        flash: &F,
        parameters: &impl Parameters,
        queue: &mut Queue<'_>,
    ) -> Result<(), Fault> {
        if self.work.has_signature() {
            match self.buffers.verification.step() {
                None => return Ok(()),
                Some(false) => return Err(Fault::Signature),
                Some(true) => {}
            }
        }
        match &mut self.work {
            Work::Idle => {}
            Work::Request(request) => {
                self.news.outcome = Outcome::Granted(*request);
                self.work = Work::Idle;
            }
            Work::Image(image) => {
                let accepted = &mut self.news.accepted;
                image.advance(&mut self.buffers, accepted, flash, parameters, queue)?;
            }
        }
        Ok(())
    }
}
