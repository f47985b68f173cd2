//! The body of an upload. It is read only when there is room for it: all uploads together have a
//! limit, and each has limits of size and of time.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::http::{header, HeaderMap, StatusCode};
use futures_util::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tokio::time::timeout;

use super::firmware::FILE_MAX;
use super::state::Notice;

/// The most bytes of all uploads at the same time: two of the largest files.
const ALL_MAX: usize = 2 * FILE_MAX;

/// The room for uploads.
#[derive(Clone, Debug)]
pub(super) struct Room {
    /// A permit for each byte.
    bytes: Arc<Semaphore>,
    /// How long an upload may send nothing.
    silent: Duration,
}

/// A file in the memory of this server; its room is free again when this is dropped.
pub(super) struct Upload {
    pub(super) bytes: Vec<u8>,
    pub(super) room: OwnedSemaphorePermit,
}

/// Why a request is refused: the status, and the words for the user.
pub(super) struct Refused(pub(super) StatusCode, pub(super) Notice);

impl Refused {
    pub(super) fn new(status: StatusCode, words: impl Into<String>, advice: &str) -> Self {
        Self(status, Notice::failed(words, advice))
    }
}

impl Room {
    pub(super) fn new(silent: Duration) -> Self {
        Self { bytes: Arc::new(Semaphore::new(ALL_MAX)), silent }
    }

    /// Reserves room for the announced length, or for the largest file, and reads the body.
    ///
    /// # Errors
    /// [`Refused`] with 503 if there is no room, before anything is read; 413 for more than was
    /// announced or than a file may have; 408 after a silence; 400 for a body that breaks off.
    pub(super) async fn read(&self, headers: &HeaderMap, body: Body) -> Result<Upload, Refused> {
        let announced = headers.get(header::CONTENT_LENGTH);
        let announced = announced.and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
        let most = announced.unwrap_or(FILE_MAX).min(FILE_MAX);
        let room = self.reserve(most)?;
        let bytes = self.take(body, most).await?;
        Ok(Upload { bytes, room })
    }

    fn reserve(&self, bytes: usize) -> Result<OwnedSemaphorePermit, Refused> {
        // A file has less than 2^32 bytes.
        self.bytes.clone().try_acquire_many_owned(bytes as u32).map_err(|_| {
            let words = "coflash is taking other files, and has no room for one more";
            Refused::new(StatusCode::SERVICE_UNAVAILABLE, words, "wait a moment, and choose the file again")
        })
    }

    /// The bytes of a body with at most so many.
    async fn take(&self, body: Body, most: usize) -> Result<Vec<u8>, Refused> {
        let again = "choose the file again";
        let mut parts = body.into_data_stream();
        let mut bytes = Vec::new();
        loop {
            let part = timeout(self.silent, parts.next())
                .await
                .map_err(|_| Refused::new(StatusCode::REQUEST_TIMEOUT, "the file stopped arriving", again))?;
            let Some(part) = part else { return Ok(bytes) };
            let part = part.map_err(|_| {
                Refused::new(StatusCode::BAD_REQUEST, "the file did not arrive as a whole", again)
            })?;
            if part.len() > most - bytes.len() {
                let words = format!("the file has more than {most} bytes");
                return Err(Refused::new(
                    StatusCode::PAYLOAD_TOO_LARGE,
                    words,
                    "choose the firmware file itself",
                ));
            }
            bytes.extend_from_slice(&part);
        }
    }
}
