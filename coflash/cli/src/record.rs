//! Records a run: the log of `--log-file`, and the folder of `--report-dir` for the service
//! department.
//!
//! One record serves the whole program, so that code with a message need not have access to it.

use std::fs::{self, File};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::Duration;

use canopen::{Frame, NodeId};
use coboot_can::candump::Line;
use coboot_can::decode::Decoder;
use coboot_can::redact::Redactor;
use coboot_can::{wall, Adapter, Tap};
use coflash_core::file::limit::read_text;
use coflash_core::update::{stamp, Event, Histories};
use serde_json::{json, Value};

use super::secrets;

/// The files of a run's folder: the report, the events, the messages, the frames.
pub(super) const FILES: [&str; 4] = ["report.json", "events.jsonl", "log.txt", "trace.log"];

static RECORD: OnceLock<Record> = OnceLock::new();

/// The open files. They are written as events happen, so that a killed program leaves everything up
/// to that point.
struct Record {
    logs: Vec<Sink>,
    report: Option<Report>,
}

struct Report {
    folder: PathBuf,
    events: Sink,
    trace: Sink,
    /// `report.json`, written at the beginning and again at the end.
    document: Mutex<Value>,
    /// What the devices of the bus have shown, if the command has one.
    histories: Mutex<Histories>,
}

/// The most failed updates of a run: the latest ones count.
const MOST_FAILED: usize = 127;

/// A file that may become full. The first error is shown, and the command continues.
struct Sink {
    name: String,
    file: Mutex<Option<File>>,
}

impl Sink {
    fn new(path: &Path) -> Result<Self, String> {
        let name = path.display().to_string();
        match File::create(path) {
            Ok(file) => Ok(Self { name, file: Mutex::new(Some(file)) }),
            Err(error) => Err(cannot(path, &error)),
        }
    }

    fn line(&self, line: &str) {
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(open) = file.as_mut() else { return };
        if let Err(error) = open.write_all(format!("{}\n", secrets::without_urls(line)).as_bytes()) {
            *file = None;
            let _ = writeln!(io::stderr(), "warning: {}: writing failed: {error}", self.name);
        }
    }
}

fn cannot(path: &Path, error: &io::Error) -> String {
    format!("{}: cannot be written: {error}", path.display())
}

/// Starts the records that the command line asks for. `command` is the command's full name; the folder
/// has it, too. `line` is what was typed, without secrets.
pub(super) fn begin(
    log: Option<&Path>,
    reports: Option<&Path>,
    command: &str,
    line: &[String],
    bus: Option<&str>,
) -> Result<(), String> {
    let mut logs: Vec<Sink> = log.map(Sink::new).transpose()?.into_iter().collect();
    let report = match reports {
        Some(folder) => {
            let folder = own_folder(folder, &command.replace(' ', "-"))?;
            let [_, events, messages, frames] = FILES.map(|file| folder.join(file));
            logs.push(Sink::new(&messages)?);
            let document = json!({
                "coflash": env!("COFLASH_VERSION"),
                "system": format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
                "command": command,
                "command_line": line,
                "bus": bus,
                "began": stamp(wall()),
                "ended": null,
            });
            let report = Report {
                events: Sink::new(&events)?,
                trace: Sink::new(&frames)?,
                document: Mutex::new(document),
                histories: Mutex::default(),
                folder,
            };
            report.write(&[])?;
            Some(report)
        }
        None => None,
    };
    if !logs.is_empty() {
        let record = RECORD.get_or_init(|| Record { logs, report });
        record.note("command", &line.join(" "));
    }
    Ok(())
}

/// Creates a folder for this run.
fn own_folder(all: &Path, command: &str) -> Result<PathBuf, String> {
    fs::create_dir_all(all).map_err(|error| cannot(all, &error))?;
    let time: String = stamp(wall()).chars().filter(|c| !matches!(c, '-' | ':')).take(15).collect();
    for number in 1_u32.. {
        let name = match number {
            1 => format!("{time}-{command}"),
            number => format!("{time}-{command}-{number}"),
        };
        let folder = all.join(name);
        match fs::create_dir(&folder) {
            Ok(()) => return Ok(folder),
            // Another run in the same second.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists && number < 1000 => {}
            Err(error) => return Err(cannot(&folder, &error)),
        }
    }
    Err(format!("{}: no folder can be created in it", all.display()))
}

/// The folder of the report, if there is one.
pub(super) fn folder() -> Option<&'static Path> {
    Some(&RECORD.get()?.report.as_ref()?.folder)
}

/// Records the end of the run.
pub(super) fn end(exit: u32, error: Option<Value>) -> Result<(), String> {
    let Some(record) = RECORD.get() else { return Ok(()) };
    record.note("end", &format!("exit code {exit}"));
    let Some(report) = &record.report else { return Ok(()) };
    report.write(&[
        ("ended", stamp(wall()).into()),
        ("exit", exit.into()),
        ("error", error.unwrap_or_default()),
    ])
}

/// Whether there is a record.
pub(super) fn is_kept() -> bool {
    RECORD.get().is_some()
}

/// Records a message.
pub(super) fn note(kind: &str, words: &str) {
    if let Some(record) = RECORD.get() {
        record.note(kind, words);
    }
}

/// Records an event of a device.
pub(super) fn event(node: NodeId, event: &Event) {
    let Some(record) = RECORD.get() else { return };
    record.note("event", &format!("node {node}: {event}"));
    if let Some(report) = &record.report {
        let mut line = serde_json::to_value(event.line(node)).unwrap_or_default();
        line["time"] = stamp(wall()).into();
        report.events.line(&line.to_string());
        let mut histories = report.histories.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(update) = histories.record(wall(), node, event) {
            report.failed(json!(update));
        }
    }
}

/// Records a failed update that a page or an agent has made, at once: they end last of all.
#[cfg(any(feature = "ui", feature = "agent"))]
pub(super) fn failed(update: &coflash_core::update::FailedUpdate, more: &[(&str, &str)]) {
    let Some(report) = RECORD.get().and_then(|record| record.report.as_ref()) else { return };
    let mut value = json!(update);
    more.iter().for_each(|(name, word)| value[*name] = (*word).into());
    report.failed(value);
    // An error of writing is reported at the end of the run.
    let _ = report.write(&[]);
}

/// Records what is begun, before the first frame: it is known of a run that is killed, or loses its
/// power.
pub(super) fn begun(devices: &Value) -> Result<(), String> {
    let Some(report) = RECORD.get().and_then(|record| record.report.as_ref()) else { return Ok(()) };
    report.write(&[("begun", devices.clone())])
}

/// The documents of the runs before, the latest first: `report`, and those beside this one.
pub(super) fn before(report: Option<&Path>) -> Vec<Value> {
    let all = folder().and_then(Path::parent).and_then(|all| fs::read_dir(all).ok()).into_iter().flatten();
    let mut runs: Vec<_> = all.filter_map(|run| Some(run.ok()?.path().join(FILES[0]))).collect();
    // Their names begin with their times.
    runs.sort();
    let runs = report.map(Path::to_path_buf).into_iter().chain(runs.into_iter().rev());
    runs.filter_map(|run| serde_json::from_str(&read_text(&run).ok()?).ok()).collect()
}

/// When the update of a device's program was begun that did not end: of the runs `before`, the
/// latest with this program counts.
pub(super) fn unended(device: &Value, before: &[Value]) -> Option<String> {
    let is_of = |parts: &[&str], begun: &Value| parts.iter().all(|part| begun[*part] == device[*part]);
    before.iter().find_map(|run| {
        let begun =
            run["begun"].as_array()?.iter().find(|of| is_of(&["node", "serial_number", "program"], of))?;
        let did_not_end = run["ended"].is_null() && is_of(&["to"], begun);
        Some(did_not_end.then(|| run["began"].as_str().unwrap_or_default().to_owned()))
    })?
}

/// Replaces a file as a whole: what it had stays if there is no room for the new contents.
pub(super) fn replace(path: &Path, text: &str) -> io::Result<()> {
    // A pipe, for example.
    if fs::symlink_metadata(path).is_ok_and(|there| !there.is_file()) {
        return fs::write(path, text);
    }
    let mut builder = tempfile::Builder::new();
    // As for any new file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(text.as_bytes())?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}

/// Records the result of a command, as JSON.
pub(super) fn result(value: &Value) {
    if let Some(report) = RECORD.get().and_then(|record| record.report.as_ref()) {
        // An error of writing is reported at the end of the run.
        let _ = report.write(&[("result", value.clone())]);
    }
}

/// The adapter with a recorder for its frames.
pub(super) fn tapped(adapter: Box<dyn Adapter + Send>) -> Box<dyn Adapter + Send> {
    if !is_kept() {
        return adapter;
    }
    let (mut passwords, mut contents) = (Redactor::default(), Redactor::of_contents());
    let mut decoder = Decoder::new();
    let ear = move |time: Duration, frame: &Frame, _: bool| {
        let Some(record) = RECORD.get() else { return };
        let words = decoder.decode(&contents.frame(frame));
        let shown = passwords.frame(frame);
        let text = Line { time, interface: "can0".to_string(), frame: shown }.to_string();
        record.note("frame", &format!("{shown}  {words}"));
        if let Some(report) = &record.report {
            report.trace.line(&text);
            report.histories.lock().unwrap_or_else(PoisonError::into_inner).saw(time, frame);
        }
    };
    Box::new(Tap::new(adapter, Box::new(ear)))
}

impl Record {
    fn note(&self, kind: &str, words: &str) {
        let time = stamp(wall());
        for (number, line) in words.lines().enumerate() {
            let kind = if number == 0 { kind } else { "" };
            let line = format!("{time}  {kind:<7}  {line}");
            self.logs.iter().for_each(|log| log.line(&line));
        }
    }
}

impl Report {
    /// Adds a failed update to `report.json`.
    fn failed(&self, update: Value) {
        let mut document = self.document.lock().unwrap_or_else(PoisonError::into_inner);
        match document["failed_updates"].as_array_mut() {
            Some(updates) => {
                // A server, a page or an agent may run for years.
                let over = (updates.len() + 1).saturating_sub(MOST_FAILED);
                updates.drain(..over);
                updates.push(update);
            }
            None => document["failed_updates"] = json!([update]),
        }
    }

    /// Writes `report.json` with these additional entries. If there is no room for it, that of before stays.
    fn write(&self, entries: &[(&str, Value)]) -> Result<(), String> {
        let mut document = self.document.lock().unwrap_or_else(PoisonError::into_inner);
        for (name, value) in entries {
            document[*name] = value.clone();
        }
        let path = self.folder.join(FILES[0]);
        let text = secrets::without_urls(&format!("{:#}\n", *document));
        replace(&path, &text).map_err(|error| cannot(&path, &error))
    }
}
