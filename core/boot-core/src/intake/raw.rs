//! A raw image: the program's bytes from the start of its flash.

use canopen::program::FlashError;
use canopen::AbortCode;
use shared_abi::ram_image::MAGIC;
use shared_abi::vectors::VectorTable;

use super::format::{Destination, Format, Recognition};
use super::stream::Stream;
use crate::policy::Judge;
use crate::queue::Queue;
use crate::refusal::Refusal;

pub(super) struct Raw(Stream);

impl Format for Raw {
    const IS_STREAM: bool = true;

    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self> {
        let raw = || Recognition::Yes(Self(Stream::new(judge)));
        if judge.is_data() {
            return raw();
        }
        let Some(word) = first.first_chunk() else { return Recognition::More };
        let word = u32::from_le_bytes(*word);
        let starts = match judge.is_bootloader() {
            true => word == MAGIC,
            false => VectorTable::is_stack_pointer(word, judge.layout),
        };
        if starts {
            raw()
        } else {
            Recognition::No
        }
    }

    fn begin(&mut self, size: Option<u32>, judge: &Judge<'_>, _queue: &Queue<'_>) -> Result<(), Refusal> {
        let size = size.unwrap_or(0);
        if judge.has_begun() {
            return judge.may_begin(true);
        }
        if size > judge.region.size {
            return Err(Refusal(FlashError::Address, AbortCode::LENGTH_TOO_HIGH));
        }
        self.0.set_size(size);
        judge.may_begin(true)
    }

    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        self.0.check_place(bytes.len() as u32, &to.judge)?;
        self.0.append(bytes, to)?;
        self.0.close_if_full(to)
    }

    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        self.0.end(to)
    }
}
