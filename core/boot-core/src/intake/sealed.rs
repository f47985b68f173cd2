//! A sealed image: its bytes go through the queue unchanged. The flash half (`unseal`) checks them,
//! because to check a signature takes longer than a client waits for an answer.

use canopen::program::FlashError;
use canopen::AbortCode;
use seal::wire::MAGIC;

use super::format::{Begin, Destination, Format, Recognition};
use crate::keys::Linked;
use crate::policy::Judge;
use crate::program::Expected;
use crate::queue::Queue;
use crate::refusal::Refusal;
use crate::resume::Partial;

pub(super) struct SealedImage(Linked);

impl Format for SealedImage {
    const IS_STREAM: bool = true;

    fn recognise(first: &[u8], judge: &Judge<'_>) -> Recognition<Self> {
        let Some(linked) = judge.images.sealed() else { return Recognition::No };
        match (MAGIC.starts_with(first), first.len() == MAGIC.len()) {
            (true, true) => Recognition::Yes(Self(linked)),
            (true, false) => Recognition::More,
            _ => Recognition::No,
        }
    }

    fn begin(&mut self, _size: Option<u32>, judge: &Judge<'_>, _queue: &Queue<'_>) -> Result<(), Refusal> {
        judge.may_begin(true)
    }

    fn data(&mut self, bytes: &[u8], to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        if !to.queue.push_bytes(bytes) {
            // A client that waits for the answers never causes this.
            return Err(Refusal(FlashError::Busy, AbortCode::OUT_OF_MEMORY));
        }
        if !to.judge.has_begun() {
            to.findings.begins = Some(Begin {
                size: 0,
                version: 0,
                date: 0,
                partial: Partial::begin(0, to.judge.region.base),
            });
            to.findings.sealed = Some(self.0);
        }
        Ok(())
    }

    fn end(&mut self, to: &mut Destination<'_, '_>) -> Result<(), Refusal> {
        // The manifest describes the program.
        to.findings.complete = Some(Expected { size: 0, crc: None });
        Ok(())
    }
}
