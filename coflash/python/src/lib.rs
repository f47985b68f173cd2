//! coflash for Python: the library's procedure, `info` and `scan` as functions of a module.
//!
//! The work runs in a separate thread without Python's lock (GIL). The calling thread waits without
//! the lock, too, and takes the lock for each event and to check for Ctrl-C.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{channel, RecvTimeoutError, Sender};
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use canopen::NodeId;
use coboot_can::decode::state_words;
use coboot_can::Link;
use coflash_core::device::{self, Dialect, ScanOptions, Session, Timing};
use coflash_core::file::{self, limit, Format};
use coflash_core::update::{self, ContentFault, FlashOptions, Judging, Password, Payload, Reading};
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use serde::Serialize;
use serde_json::{json, Value};

mod fault;

use self::fault::Fault;

/// The longest time until Ctrl-C is noticed.
const LOOK: Duration = Duration::from_millis(50);

/// Converts firmware and downloads it over CANopen; the package `coflash` re-exports these
/// functions.
#[pymodule]
mod _native {
    use pyo3::prelude::*;

    #[pymodule_export]
    use super::{flash, info, scan};

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        module.add("__version__", env!("CARGO_PKG_VERSION"))
    }
}

/// Downloads a program into a device, and starts it; a bootloader renews that of the device.
///
/// `bus` is a URL as for the command line's `--bus`. The file is read and checked before the bus is
/// opened. `on_event` is called with a dictionary for each event, the last one being `done`. If it
/// raises an exception, the update is cancelled in an orderly way, and the exception is raised
/// again.
#[pyfunction]
#[pyo3(signature = (bus, node, file, on_event=None, *, board=None, address=None, program=1, check_target=false,
                    trial_run=true, start=true, verify=false, repeats=3, dialect=None, unlock=None,
                    sdo_timeout=0.5))]
#[allow(clippy::too_many_arguments, reason = "they are named in Python")]
fn flash<'py>(
    py: Python<'py>,
    bus: String,
    node: u8,
    file: PathBuf,
    on_event: Option<Bound<'py, PyAny>>,
    board: Option<String>,
    address: Option<u32>,
    program: u8,
    check_target: bool,
    trial_run: bool,
    start: bool,
    verify: bool,
    repeats: u32,
    dialect: Option<String>,
    unlock: Option<String>,
    sdo_timeout: f64,
) -> PyResult<Bound<'py, PyAny>> {
    let (node, timing) = (node_id(node)?, timing(sdo_timeout)?);
    if !(1..=254).contains(&program) {
        return Err(PyValueError::new_err("programs are 1 to 254"));
    }
    let content = payload_of(&file, board.as_deref(), address, program).map_err(|fault| fault.raise(py))?;
    let target = match check_target {
        false => None,
        true => Some(content.target().ok_or_else(|| {
            PyValueError::new_err("check_target: the file does not name its target device")
        })?),
    };
    let options = FlashOptions::default()
        .program(program)
        .check_target(target)
        .trial_run(trial_run)
        .start(start)
        .verify(verify)
        .repeats(repeats)
        .dialect(dialect.as_deref().map(dialect_of).transpose()?)
        .unlock(unlock.as_deref().map(password).transpose()?);
    let report = work(py, on_event.as_ref(), |cancelled, events| {
        let mut link = Link::open(&bus, None).map_err(device::Error::from)?;
        let mut session = Session::on(&mut link, node, timing);
        session.cancel_by(cancelled);
        // The receiver is gone only if the update was cancelled.
        let mut tell = |event: update::Event| drop(events.send(json!(event.line(node))));
        Ok(update::flash(&mut session, &content, &options, &mut tell)?)
    })?;
    object(py, &report)
}

/// Reads a device's information and the state of its programs.
#[pyfunction]
#[pyo3(signature = (bus, node, *, sdo_timeout=0.5))]
fn info(py: Python<'_>, bus: String, node: u8, sdo_timeout: f64) -> PyResult<Bound<'_, PyAny>> {
    let (node, timing) = (node_id(node)?, timing(sdo_timeout)?);
    let info = work(py, None, |cancelled, _| {
        let mut link = Link::open(&bus, None).map_err(device::Error::from)?;
        let mut session = Session::on(&mut link, node, timing);
        session.cancel_by(cancelled);
        Ok(device::info(&mut session)?)
    })?;
    object(py, &info)
}

/// Sends requests to all nodes, and listens for heartbeats for this many seconds; returns the nodes
/// by node-ID.
#[pyfunction]
#[pyo3(signature = (bus, nodes=None, *, listen=1.1))]
fn scan<'py>(
    py: Python<'py>,
    bus: String,
    nodes: Option<Vec<u8>>,
    listen: f64,
) -> PyResult<Bound<'py, PyDict>> {
    let mut options = ScanOptions::default().listen(seconds("listen", listen)?);
    if let Some(nodes) = nodes {
        options = options.nodes(nodes.into_iter().map(node_id).collect::<PyResult<_>>()?);
    }
    let found = work(py, None, |cancelled, _| {
        let mut adapter = coboot_can::open(&bus).map_err(device::Error::from)?;
        Ok(device::scan(&mut *adapter, &options, &cancelled)?)
    })?;
    let nodes = PyDict::new(py);
    for (node, found) in found {
        let value = json!({ "state": found.state.map(state_words), "info": found.info, "but": found.but });
        nodes.set_item(node.get(), object(py, &value)?)?;
    }
    Ok(nodes)
}

/// Runs work in a separate thread, and passes its events to Python meanwhile.
fn work<T: Send>(
    py: Python<'_>,
    on_event: Option<&Bound<'_, PyAny>>,
    act: impl FnOnce(Arc<AtomicBool>, &Sender<Value>) -> Result<T, Fault> + Send,
) -> PyResult<T> {
    let cancelled = Arc::new(AtomicBool::new(false));
    let (events, mut inbox) = channel();
    let (result, raised) = thread::scope(|scope| {
        let flag = cancelled.clone();
        // `events` moves into the thread: the channel ends when the work ends.
        let worker = scope.spawn(move || act(flag, &events));
        let mut raised: Option<PyErr> = None;
        loop {
            let received;
            (inbox, received) = py.detach(move || {
                let received = inbox.recv_timeout(LOOK);
                (inbox, received)
            });
            let outcome = match received {
                Ok(_) if raised.is_some() => Ok(()),
                Ok(event) => tell(py, on_event, &event).and_then(|()| py.check_signals()),
                Err(RecvTimeoutError::Timeout) if raised.is_some() => Ok(()),
                Err(RecvTimeoutError::Timeout) => py.check_signals(),
                Err(RecvTimeoutError::Disconnected) => break,
            };
            if let Err(error) = outcome {
                cancelled.store(true, Ordering::Relaxed);
                raised = Some(error);
            }
        }
        (py.detach(|| worker.join()), raised)
    });
    if let Some(raised) = raised {
        return Err(raised);
    }
    match result {
        Ok(result) => result.map_err(|fault| fault.raise(py)),
        Err(_) => {
            Err(PyRuntimeError::new_err("there was an internal error of coflash: its thread has panicked"))
        }
    }
}

fn tell(py: Python<'_>, on_event: Option<&Bound<'_, PyAny>>, event: &Value) -> PyResult<()> {
    match on_event {
        Some(on_event) => on_event.call1((object(py, event)?,)).map(drop),
        None => Ok(()),
    }
}

/// A value as a Python object.
fn object<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    Ok(pythonize::pythonize(py, value)?)
}

/// A bootloader, a sealed image unchanged, or the program of any other file, for this board if one is named; a raw
/// binary gets its address.
fn payload_of(
    path: &std::path::Path,
    board: Option<&str>,
    address: Option<u32>,
    program: u8,
) -> Result<Payload, Fault> {
    let board = board.map(file::board::named).transpose().map_err(|error| Fault::Value(error.to_string()))?;
    let name = || path.display().to_string();
    let bytes = limit::read(path).map_err(|cause| Fault::File(file::Place::File.fault(cause).of(name())))?;
    let reading = Reading::new(program)
        .format(address.map(|_| Format::Raw))
        .address(address)
        .board(board)
        // The update judges the rest, but does not know the board.
        .judging(Judging::Handoff);
    let loaded = reading.read(path, &bytes).map_err(|fault| match fault {
        ContentFault::Bootloader(fault) => Fault::Bootloader(name(), fault),
        ContentFault::Sealed(refusal) => Fault::Sealed(name(), refusal),
        ContentFault::File(error) => Fault::File(error.of(name())),
        fault => Fault::Value(fault.to_string()),
    })?;
    Ok(loaded.payload)
}

fn node_id(number: u8) -> PyResult<NodeId> {
    NodeId::new(number).ok_or_else(|| PyValueError::new_err("node-IDs are 1 to 127"))
}

fn dialect_of(name: &str) -> PyResult<Dialect> {
    let known = || Dialect::ALL.map(Dialect::name).join(", ");
    Dialect::named(name)
        .ok_or_else(|| PyValueError::new_err(format!("there is no dialect '{name}'; known are {}", known())))
}

fn password(text: &str) -> PyResult<Password> {
    Password::new(text).ok_or_else(|| PyValueError::new_err("a password has 1 to 64 bytes"))
}

fn timing(sdo: f64) -> PyResult<Timing> {
    Ok(Timing::default().sdo(seconds("sdo_timeout", sdo)?))
}

/// A time from Python in seconds; a day is the longest permitted time.
fn seconds(name: &str, time: f64) -> PyResult<Duration> {
    let sound = (0.0..=86_400.0).contains(&time);
    let wrong = || PyValueError::new_err(format!("{name} must be seconds, 0 to 86400"));
    sound.then(|| Duration::from_secs_f64(time)).ok_or_else(wrong)
}
