//! The state that the server and the thread of the bus share.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use canopen::NodeId;
use tokio::sync::watch;

use coboot_can::Link;
use coflash_core::update::{Event, FailedUpdate};

use super::firmware::Loaded;
use super::frames::Frames;
use super::state::{Connection, Notice, State};

/// What is done with what a device has shown whose update has failed.
#[derive(Clone)]
pub struct Failed(Arc<dyn Fn(&FailedUpdate) + Send + Sync>);

impl Failed {
    /// Calls this function for each.
    #[must_use]
    pub fn new(act: impl Fn(&FailedUpdate) + Send + Sync + 'static) -> Self {
        Self(Arc::new(act))
    }
}

impl Default for Failed {
    fn default() -> Self {
        Self::new(|_| {})
    }
}

impl fmt::Debug for Failed {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Failed").finish_non_exhaustive()
    }
}

/// An order for the thread of the bus.
pub(super) enum Order {
    /// Open this adapter and keep it.
    Open(String),
    /// Close the adapter.
    Close,
    /// End.
    End,
    /// Run this task. [`Shared::begin`] has entered it as the running one.
    Run(Box<dyn Work>),
}

/// A task for the thread of the bus. Each page has its own.
pub(super) trait Work: Send {
    /// Enters the task as the running one.
    fn enter(&self, state: &mut State);

    /// Carries it out, and returns its result.
    fn run(self: Box<Self>, link: &mut Link, shared: &Shared) -> Notice;
}

/// Why a task does not start, in words for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// Another task is running.
    Busy(String),
    /// An adapter or a file is missing.
    NotReady(&'static str),
}

/// The state that the server and the thread of the bus share.
pub(super) struct Shared {
    state: Mutex<State>,
    /// The number of changes of the state.
    pub(super) changed: watch::Sender<u64>,
    pub(super) frames: Arc<Mutex<Frames>>,
    /// The number of the last frame.
    pub(super) arrived: watch::Sender<u64>,
    /// Cancels the running task.
    pub(super) cancelled: Arc<AtomicBool>,
    pub(super) firmware: Mutex<Option<Arc<Loaded>>>,
    pub(super) readback: Mutex<Option<Arc<Vec<u8>>>>,
    /// The version of the tool, with its commit.
    pub(super) tool: String,
    failed: Failed,
    orders: SyncSender<Order>,
}

/// Locks the mutex even after a panic of another thread: each value is changed as a whole, so it is
/// valid.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub(super) fn new(orders: SyncSender<Order>, failed: Failed, tool: String) -> Self {
        Self {
            state: Mutex::default(),
            changed: watch::Sender::new(1),
            frames: Arc::default(),
            arrived: watch::Sender::new(0),
            cancelled: Arc::default(),
            firmware: Mutex::default(),
            readback: Mutex::default(),
            tool,
            failed,
            orders,
        }
    }

    /// Changes the state, and notifies all pages.
    pub(super) fn change<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        let result = change(&mut lock(&self.state));
        self.changed.send_modify(|version| *version += 1);
        result
    }

    /// Remembers an event of an update, and reports the update if it has failed.
    pub(super) fn record(&self, node: NodeId, event: &Event) {
        let failed = lock(&self.frames).record(node, event);
        if let Some(update) = failed {
            (self.failed.0)(&update);
        }
    }

    /// Reads the state.
    pub(super) fn read<R>(&self, read: impl FnOnce(&State) -> R) -> R {
        read(&lock(&self.state))
    }

    /// Starts a task if no other one is running.
    ///
    /// # Errors
    /// [`Refusal`]; then nothing has changed.
    pub(super) fn begin(&self, work: impl Work + 'static) -> Result<(), Refusal> {
        self.change(|state| {
            if let Some(task) = &state.task {
                return Err(Refusal::Busy(task.words.clone()));
            }
            if state.adapter.state != Connection::Open {
                return Err(Refusal::NotReady("no adapter is open"));
            }
            work.enter(state);
            self.cancelled.store(false, Ordering::Relaxed);
            self.order(Order::Run(Box::new(work))).inspect_err(|_| state.task = None)
        })
    }

    /// Sends an order to the thread of the bus.
    ///
    /// # Errors
    /// [`Refusal::Busy`] if the thread has not yet read the previous order.
    pub(super) fn order(&self, order: Order) -> Result<(), Refusal> {
        self.orders.try_send(order).map_err(|_| Refusal::Busy("the adapter is being opened".to_string()))
    }

    /// Cancels the running task, if there is one: its transfer is aborted.
    pub(super) fn cancel(&self) {
        self.change(|state| {
            if let Some(task) = &mut state.task {
                task.cancelling = true;
                self.cancelled.store(true, Ordering::Relaxed);
            }
        });
    }
}
