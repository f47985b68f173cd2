//! The stream of events to a page: the whole state after each change, the seconds of the plot, and
//! frames in words for pages that show them.
//!
//! There is no queue for a reader: each pass sends the current data. A slow reader misses states
//! that were replaced meanwhile and frames that are too old; a reader that stops reading is dropped
//! by the time-out of its connection.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::response::sse::{Event, Sse};
use coboot_can::wall;
use futures_util::stream::{self, Stream};
use serde_json::{json, Value};
use tokio::sync::{watch, OwnedSemaphorePermit, Semaphore};
use tokio::time::sleep;

use super::shared::{lock, Shared};
use super::state::State;

/// The shortest time between two events.
const PACE: Duration = Duration::from_millis(150);
/// The longest time between two events: without events the page reports a lost connection.
const BEAT: Duration = Duration::from_secs(1);
/// The most readers at the same time.
const READERS: usize = 32;

/// The places of the readers.
#[derive(Clone, Debug)]
pub(super) struct Readers(Arc<Semaphore>);

impl Default for Readers {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(READERS)))
    }
}

impl Readers {
    /// The number of readers.
    pub(super) fn count(&self) -> usize {
        READERS - self.0.available_permits()
    }
}

/// What a page gets of the state.
pub(super) type View = Arc<dyn Fn(&State) -> Value + Send + Sync>;

struct Reader {
    shared: Arc<Shared>,
    view: View,
    changed: watch::Receiver<u64>,
    arrived: watch::Receiver<u64>,
    /// The number of the last frame that was sent to this reader, if it wants frames.
    frames: Option<u64>,
    /// The last second of the plot that was sent to this reader.
    second: u64,
    /// The version of the state that was sent to this reader; 0 for none.
    version: u64,
    _place: OwnedSemaphorePermit,
}

/// A stream for one more reader; `None` if there are too many.
pub(super) fn stream(
    shared: Arc<Shared>,
    view: View,
    readers: &Readers,
    frames: bool,
) -> Option<Sse<impl Stream<Item = Result<Event, Infallible>>>> {
    let place = readers.0.clone().try_acquire_owned().ok()?;
    let reader = Reader {
        changed: shared.changed.subscribe(),
        arrived: shared.arrived.subscribe(),
        frames: frames.then_some(0),
        second: 0,
        version: 0,
        shared,
        view,
        _place: place,
    };
    Some(Sse::new(stream::unfold(reader, |mut reader| async {
        let value = reader.next().await;
        Some((Ok(Event::default().data(value.to_string())), reader))
    })))
}

impl Reader {
    /// Waits for new data, or until the next empty event is due.
    async fn next(&mut self) -> Value {
        if self.version != 0 {
            sleep(PACE).await;
            let wants_frames = self.frames.is_some();
            // If the other side of a watch ends, the empty events continue.
            tokio::select! {
                Ok(()) = self.changed.changed() => {}
                Ok(()) = self.arrived.changed(), if wants_frames => {}
                () = sleep(BEAT) => {}
            }
        }
        let mut value = json!({});
        let version = *self.changed.borrow_and_update();
        if version != self.version {
            self.version = version;
            value["state"] = self.shared.read(|state| (self.view)(state));
        }
        let now = wall().as_secs();
        let frames = lock(&self.shared.frames);
        let seconds = frames.seconds_after(self.second, now);
        self.second = seconds.last().map_or(self.second, |last| last.second);
        value["now"] = now.into();
        value["seconds"] = json!(seconds);
        if let Some(last) = self.frames {
            self.arrived.mark_unchanged();
            value["frames"] = json!(frames.rows_after(last));
            self.frames = Some(frames.count());
        }
        value["count"] = frames.count().into();
        value
    }
}
