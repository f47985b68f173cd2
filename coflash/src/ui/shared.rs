//! What the server and the thread that owns the bus share.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::watch;

use super::firmware::Loaded;
use super::frames::Frames;
use super::job::Job;
use super::state::{Connection, State};

/// What the thread that owns the bus is told.
pub(super) enum Order {
    /// Open this adapter, and stay with it.
    Open(String),
    /// Let go of the adapter.
    Close,
    /// That is all.
    End,
    /// Do this. [`Shared::begin`] has entered it as the task that runs.
    Run(Job),
}

/// Why something is not begun. The words are for people.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Refusal {
    /// Something else is being done.
    Busy(String),
    /// There is no adapter, or no file.
    NotReady(&'static str),
}

/// What the server and the thread that owns the bus share.
pub(super) struct Shared {
    state: Mutex<State>,
    /// Counts the changes of the state.
    pub(super) changed: watch::Sender<u64>,
    pub(super) frames: Arc<Mutex<Frames>>,
    /// The number of the last frame.
    pub(super) arrived: watch::Sender<u64>,
    /// Ends the task that runs.
    pub(super) cancelled: Arc<AtomicBool>,
    pub(super) firmware: Mutex<Option<Arc<Loaded>>>,
    pub(super) readback: Mutex<Option<Arc<Vec<u8>>>>,
    orders: SyncSender<Order>,
}

/// A panic of another thread leaves what is behind a lock whole: it is changed value by value.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    pub(super) fn new(orders: SyncSender<Order>) -> Self {
        Self {
            state: Mutex::default(),
            changed: watch::Sender::new(1),
            frames: Arc::default(),
            arrived: watch::Sender::new(0),
            cancelled: Arc::default(),
            firmware: Mutex::default(),
            readback: Mutex::default(),
            orders,
        }
    }

    /// Changes the state, and has all pages told.
    pub(super) fn change<R>(&self, change: impl FnOnce(&mut State) -> R) -> R {
        let result = change(&mut lock(&self.state));
        self.changed.send_modify(|version| *version += 1);
        result
    }

    /// Looks at the state.
    pub(super) fn look<R>(&self, look: impl FnOnce(&State) -> R) -> R {
        look(&lock(&self.state))
    }

    /// Begins a job, if nothing else is being done.
    ///
    /// # Errors
    /// [`Refusal`]; then nothing has changed.
    pub(super) fn begin(&self, job: Job) -> Result<(), Refusal> {
        self.change(|state| {
            if let Some(task) = &state.task {
                return Err(Refusal::Busy(task.words.clone()));
            }
            if state.adapter.state != Connection::Open {
                return Err(Refusal::NotReady("no adapter is open"));
            }
            job.enter(state);
            self.cancelled.store(false, Ordering::Relaxed);
            self.order(Order::Run(job)).inspect_err(|_| state.task = None)
        })
    }

    /// Tells the thread that owns the bus something.
    ///
    /// # Errors
    /// [`Refusal::Busy`] where it has not yet got to what it was told before.
    pub(super) fn order(&self, order: Order) -> Result<(), Refusal> {
        self.orders.try_send(order).map_err(|_| Refusal::Busy("the adapter is being opened".to_string()))
    }

    /// Ends the task that runs, if one does: its transfer is aborted.
    pub(super) fn cancel(&self) {
        self.change(|state| {
            if let Some(task) = &mut state.task {
                task.cancelling = true;
                self.cancelled.store(true, Ordering::Relaxed);
            }
        });
    }
}
