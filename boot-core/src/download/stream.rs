//! A whole program in one SDO download: a raw image, or Intel HEX.
//!
//! The bytes are cut into pieces which join the queue as blocks of the block file do, so that the
//! flash half knows one thing only. A piece joins when all that it holds was judged: the first one
//! opens the session, and until then nothing is lost.

#[cfg(feature = "intel-hex")]
use super::ihex::{Event, Hex};
use super::*;
use shared_abi::block_file::Identity;
use shared_abi::label::Label;

/// Data of a piece: so long that the flash is kept busy, so short that a small queue holds some.
const PIECE: usize = 1024;
/// Part of the queue that is filled slowly, so that a client whose data find the flash erasing
/// still gets its answers in time. An erasure of 2 s at 7 bytes every
/// [`HOLD_MS`](canopen::sdo::server::HOLD_MS) needs 7 KiB.
const RESERVE: usize = 8 * 1024;

/// A program on its way in.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stream {
    format: Format,
    /// Where the next byte goes.
    next: u32,
    /// Behind the highest byte so far.
    end: u32,
    /// Bytes of the image, where that is known: it may be erased that far before there are data.
    size: u32,
}

#[derive(Clone, Copy, Debug)]
enum Format {
    #[cfg(feature = "raw-image")]
    Raw,
    #[cfg(feature = "intel-hex")]
    Hex(Hex),
}

impl<P: Parameters, const PROGRAMS: usize> Downloader<'_, P, PROGRAMS> {
    /// Bytes that [`block_data`](Self::block_data) takes at present. Blocks have their room before
    /// they begin, so this is about streams: `held` for a client whose answer is already being held
    /// back, which may use the reserve.
    #[must_use]
    pub fn space(&self, held: bool) -> usize {
        let stream = match &self.reception {
            Reception::Stream { stream, .. } => stream,
            // More of it may arrive before it is known what it is.
            Reception::Unknown { .. } => return self.queue.free() / 2,
            _ => return usize::MAX,
        };
        let reserve = RESERVE.min(self.queue.capacity() / 4);
        // The piece that is open will be framed, and another one may begin.
        let keep = 2 * FRAMING + if held { 0 } else { reserve };
        let free = self.queue.free().saturating_sub(keep);
        match stream.format {
            #[cfg(feature = "raw-image")]
            Format::Raw => free,
            // Records of a byte each, all over the flash, are a piece each: 20 bytes of the queue
            // for 13 characters.
            #[cfg(feature = "intel-hex")]
            Format::Hex(_) => free / 2,
        }
    }

    /// Tells the format by the first bytes, as soon as they suffice, and takes them.
    pub(super) fn detect_format(&mut self, program: u8, size: Option<u32>) -> Result<(), Refusal> {
        let (len, first) = (self.queue.open(), self.queue.of_open::<4>(0));
        let region = self.region(program);
        let stream = |format, size| Stream { format, next: region.base, end: region.base, size };
        let stream = match u32::from_le_bytes(first) {
            #[cfg(feature = "raw-image")]
            _ if self.policy.data == Some(program) => {
                if size.is_some_and(|size| size > region.size) {
                    return Err(Refusal(FlashError::Address, AbortCode::LENGTH_TOO_HIGH));
                }
                stream(Format::Raw, size.unwrap_or(0))
            }
            #[cfg(feature = "intel-hex")]
            _ if first[0] == b':' && !self.has_begun(program) => stream(Format::Hex(Hex::new()), 0),
            _ if len < first.len() => return Ok(()),
            // Blocks are counted, and no flash holds as many as that.
            number if number <= 0xFFFF || number == NUMBER_LAST => {
                if size.is_some_and(|size| size as usize > self.largest()) {
                    return Err(Refusal(FlashError::Format, AbortCode::LENGTH_TOO_HIGH));
                }
                self.reception = Reception::Header { program };
                return Ok(());
            }
            _ if self.has_begun(program) => return Err(untimely(FlashError::Sequence)),
            #[cfg(feature = "raw-image")]
            stack if VectorTable::is_stack_pointer(stack, self.layout) => {
                if size.is_some_and(|size| size > region.size) {
                    return Err(Refusal(FlashError::Address, AbortCode::LENGTH_TOO_HIGH));
                }
                stream(Format::Raw, size.unwrap_or(0))
            }
            _ => return Err(unfit(FlashError::Format)),
        };
        self.may_begin(program)?;
        // What came is at most one segment.
        let mut came = [0; 8];
        let len = len.min(came.len());
        came.copy_from_slice(&self.queue.of_open::<8>(0));
        self.queue.discard_open();
        self.reception = Reception::Stream { program, stream };
        self.stream_data(program, stream, &came[..len])
    }

    /// The next bytes of the stream.
    pub(super) fn stream_data(
        &mut self,
        program: u8,
        mut stream: Stream,
        data: &[u8],
    ) -> Result<(), Refusal> {
        match &mut stream.format {
            #[cfg(feature = "raw-image")]
            Format::Raw => {
                self.place(program, &mut stream, data.len() as u32)?;
                self.append(&mut stream, data)?;
                if self.queue.open() >= HEADER_SIZE + self.piece() {
                    self.close(program, &stream)?;
                }
            }
            #[cfg(feature = "intel-hex")]
            Format::Hex(hex) => {
                let mut hex = *hex;
                for character in data {
                    match hex.push(*character)? {
                        Event::Nothing => {}
                        // A record has to be there as a whole, beside the piece that it belongs to.
                        Event::Data { size, .. }
                            if size as usize + 4 * FRAMING > self.queue.capacity() / 2 =>
                        {
                            return Err(Refusal(FlashError::Format, AbortCode::OUT_OF_MEMORY));
                        }
                        Event::Data { address, size } => {
                            if address != stream.next {
                                self.close(program, &stream)?;
                                stream.next = address;
                            }
                            self.place(program, &mut stream, size)?;
                        }
                        Event::Byte(byte) => self.append(&mut stream, &[byte])?,
                        Event::Good if self.queue.open() >= HEADER_SIZE + self.piece() => {
                            self.close(program, &stream)?;
                        }
                        Event::Good => {}
                    }
                }
                stream.format = Format::Hex(hex);
            }
        }
        self.reception = Reception::Stream { program, stream };
        Ok(())
    }

    /// The client has sent all of it.
    pub(super) fn stream_end(&mut self, program: u8, stream: Stream) -> Result<(), Refusal> {
        #[cfg(feature = "intel-hex")]
        if matches!(stream.format, Format::Hex(hex) if !hex.has_ended()) {
            return Err(unfit(FlashError::Format));
        }
        let size = stream.end - self.region(program).base;
        if size < if self.policy.data == Some(program) { 1 } else { SMALLEST_PROGRAM } {
            return Err(unfit(FlashError::Format));
        }
        self.close(program, &stream)?;
        self.expect(program, Expected { size, crc: None });
        self.start_verified = self.policy.starts_by_itself;
        if let Some(state) = self.state(program) {
            state.streamed = true;
        }
        Ok(())
    }

    fn piece(&self) -> usize {
        PIECE.min(self.queue.capacity() / 8)
    }

    /// Whether so many bytes may stand where the next one goes.
    fn place(&self, program: u8, stream: &mut Stream, size: u32) -> Result<(), Refusal> {
        self.check_place(program, Region::new(stream.next, size))?;
        stream.end = stream.end.max(stream.next + size);
        Ok(())
    }

    fn append(&mut self, stream: &mut Stream, data: &[u8]) -> Result<(), Refusal> {
        // The size is filled in when it is known.
        let header = Header { number: 0, flash_address: stream.next, size: 0 };
        if (self.queue.open() == 0 && !self.queue.push(&header.emit())) || !self.queue.push(data) {
            // Nobody who waits for the answers gets here.
            return Err(Refusal(FlashError::Busy, AbortCode::OUT_OF_MEMORY));
        }
        stream.next += data.len() as u32;
        Ok(())
    }

    /// The open piece joins the queue.
    fn close(&mut self, program: u8, stream: &Stream) -> Result<(), Refusal> {
        let Some(size) = self.queue.open().checked_sub(HEADER_SIZE) else { return Ok(()) };
        let region = self.region(program);
        if !self.has_begun(program) {
            let header = Header::parse(&self.queue.of_open(0));
            // A HEX file may begin anywhere; then its vectors are seen when all is there.
            let is_start = header.flash_address == region.base && self.policy.data != Some(program);
            if is_start && size >= SMALLEST_PROGRAM as usize {
                let [stack, reset] =
                    [0, 4].map(|at| u32::from_le_bytes(self.queue.of_open(HEADER_SIZE + at)));
                if VectorTable::check([stack, reset], region, self.layout).is_err() {
                    return Err(unfit(FlashError::Format));
                }
            }
            if is_start && size >= label::OFFSET as usize + label::SIZE {
                self.check_label(program, &self.queue.of_open(HEADER_SIZE + label::OFFSET as usize))?;
            }
            self.open_session(program, stream.size);
        }
        self.queue.patch(8, &(size as u32).to_le_bytes());
        // In place of a block's CRC: what came is judged.
        if !self.queue.push(&[0; CRC_SIZE]) {
            return Err(Refusal(FlashError::Busy, AbortCode::OUT_OF_MEMORY));
        }
        self.queue.commit();
        Ok(())
    }

    /// Whether a program is for this device, by its label; gives its version, 0 where there is no
    /// label.
    pub(super) fn check_label(&self, program: u8, bytes: &[u8; label::SIZE]) -> Result<u32, Refusal> {
        let Some(label) = Label::parse(bytes) else {
            return if self.policy.wants_label { Err(unfit(FlashError::Format)) } else { Ok(0) };
        };
        let Label { vendor_id, product_code, version, .. } = label;
        let identity = Identity { app_size: 0, vendor_id, product_code };
        self.check_identity(program, &Control::Dated { identity, version, date: 0 })?;
        Ok(version)
    }

    /// Whether a piece joined the queue: the old program is gone then.
    fn has_begun(&self, program: u8) -> bool {
        matches!(self.session_of(program), Some(Session::Open { .. }))
    }

    /// What is left of a stream that ends before its end: half a program, if any.
    pub(super) fn abort_stream(&mut self) {
        let Reception::Stream { program, .. } = self.reception else { return };
        if !self.has_begun(program) {
            return;
        }
        if let Some(state) = self.state(program) {
            state.session = Session::Failed;
            state.error.get_or_insert(FlashError::Format);
        }
        self.abort_work();
    }
}
