//! `coflash more report bundle`: what somebody needs who is to find a fault, in one archive.
//!
//! Nothing gets into it that was not read and understood: a line of a file that is no event, no
//! message and no frame stays out, so that no other file does under such a name. Firmware stays out,
//! too: the frames lose the data of programs, and messages that show memory are not taken.

use std::fs::{self, File};
use std::io::{self, BufRead as _, BufReader};
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use coboot_can::candump::Line;
use coboot_can::list;
use coboot_can::redact::Redactor;
use coflash_core::device::info::info;
use coflash_core::machine::zip::{self, is_name, Member, MAX_MEMBER, MAX_MEMBERS};
use serde_json::{json, Value};

use crate::adapters;
use crate::context::Context;
use crate::device::Device;
use crate::output::Failure;
use crate::output_file::{ready, write};
use crate::record::{self, FILES};
use crate::secrets::without_urls;

/// Collects what is needed to find a fault.
#[derive(Debug, Args)]
pub(crate) struct Report {
    #[command(subcommand)]
    job: Job,
}

#[derive(Debug, Subcommand)]
enum Job {
    /// Put versions, adapters, recorded runs and what the device says about itself into one ZIP file.
    ///
    /// It has no passwords, keys and tokens, and no firmware. A device that does not answer is no
    /// error: the file says so.
    Bundle(Bundle),
}

#[derive(Debug, Args)]
struct Bundle {
    /// The folder of a run, or a folder with those of several, as --report-dir makes them; the
    /// default is the folder that --report-dir or the configuration names.
    #[arg(value_name = "FOLDER")]
    folder: Option<PathBuf>,

    /// The file to write.
    #[arg(long, short, value_name = "FILE", default_value = "coflash-report.zip")]
    output: PathBuf,

    #[command(flatten)]
    device: Device,
}

/// The members about this computer and the device, with what they are.
const OF_NOW: [(&str, &str); 3] = [
    ("versions.json", "coflash, its commit and features, and the operating system"),
    ("adapters.json", "the CAN adapters of the computer, and the one that was used for device.json"),
    ("device.json", "what the device says about itself now (coflash info)"),
];

/// The most runs: the latest ones count.
const MOST_RUNS: usize = (MAX_MEMBERS - 1 - OF_NOW.len()) / FILES.len();

/// The commands whose messages and results may show the memory of a device.
const SHOW_CONTENTS: [&str; 3] = ["read", "debug", "shell"];

impl Report {
    pub(crate) fn run(&self, context: &Context) -> Result<(), Failure> {
        let Job::Bundle(bundle) = &self.job;
        bundle.run(context)
    }
}

impl Bundle {
    fn run(&self, context: &Context) -> Result<(), Failure> {
        let runs = self.runs()?;
        ready(&self.output)?;
        let taken = &runs[runs.len().saturating_sub(MOST_RUNS)..];
        let url = context.url(context.bus.as_deref());
        let adapters = json!({
            "in_use": url.as_ref().ok(),
            "found": adapters::value(&list(&context.kinds(), std::time::Duration::ZERO)),
        });
        let device = url.and_then(|url| self.ask(context, &url));
        let (answer, device) = match device {
            Ok(device) => ("the device has answered".to_owned(), device),
            Err(failure) => {
                let value = failure.value();
                let what = value["error"]["what"].as_str().unwrap_or_default();
                (format!("the device could not be asked: {}", without_urls(what)), value)
            }
        };
        let mut archive = Archive::default();
        for ((name, about), value) in OF_NOW.iter().zip([versions(context), adapters, device]) {
            archive.add((*name).to_owned(), about, format!("{value:#}\n"));
        }
        for run in taken {
            archive.run(run)?;
        }
        let lines = archive.members.iter().map(|member| format!("{}: {}\n", member.name, member.about));
        let readme = format!(
            "A fault of a device or of coflash: what is needed to find it.\n\n{}\nNow {answer}.\nRuns in here: {} \
             of {}, the latest ones.\n\nNot in here: passwords, keys, tokens, configuration files and firmware. \
             Passwords in frames are zeros, and so are the data of programs. Of a firmware file \
             there are the name, the size, the CRC and the identity that log.txt and report.json say. Of a file \
             with more than {} MiB the end is here. Frames are in trace.log only: coflash monitor --replay shows \
             them in words.\n",
            lines.collect::<String>(),
            taken.len(),
            runs.len(),
            MAX_MEMBER >> 20,
        );
        archive.members.insert(0, Text { name: "README.txt".to_owned(), about: "", text: readme });
        let names: Vec<&str> = archive.members.iter().map(|member| member.name.as_str()).collect();
        let members = archive.members.iter();
        let members = members.map(|member| Member { name: &member.name, bytes: member.text.as_bytes() });
        write(&self.output, &zip::write(&members.collect::<Vec<_>>()))?;
        let output = self.output.display();
        let words = format!("{output}: {} files of {} runs; {answer}", names.len(), taken.len());
        context.result(words, || {
            json!({
                "output": output.to_string(),
                "runs": taken.len(),
                "answer": answer,
                "files": names,
            })
        });
        Ok(())
    }

    /// What the device says about itself.
    fn ask(&self, context: &Context, url: &str) -> Result<Value, Failure> {
        let mut link = context.link_at(Some(url), None)?;
        let mut session = self.device.session(&mut link)?;
        let waiting = context.waiting(format!("node {} answers", session.node()));
        let info = info(&mut session).map_err(|error| Failure::diagnosed(error, &mut session))?;
        drop(waiting);
        Ok(json!(info))
    }

    /// The folders of the runs, the oldest first; the run of this command is none of them.
    fn runs(&self) -> Result<Vec<PathBuf>, Failure> {
        let own = record::folder();
        let Some(folder) = self.folder.as_deref().or_else(|| own?.parent()) else { return Ok(Vec::new()) };
        if is_run(folder) {
            return Ok(vec![folder.to_owned()]);
        }
        let entries = fs::read_dir(folder).map_err(|error| Failure::unreadable(folder, &error))?;
        let paths = entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<PathBuf>>>();
        let mut runs = paths.map_err(|error| Failure::unreadable(folder, &error))?;
        runs.retain(|path| is_run(path) && own != Some(path));
        if runs.is_empty() && self.folder.is_some() {
            let advice = "name a folder that --report-dir has made, or leave it out";
            return Err(Failure::usage(format!("{} has no recorded run", folder.display()), advice));
        }
        // Their names begin with their times.
        runs.sort();
        Ok(runs)
    }
}

/// Whether a folder is that of a run.
fn is_run(folder: &Path) -> bool {
    folder.join(FILES[0]).is_file()
}

/// The versions of the tool and of the system it runs on. Of the environment only names are taken.
fn versions(context: &Context) -> Value {
    let features = [
        ("ui", cfg!(feature = "ui")),
        ("agent", cfg!(feature = "agent")),
        ("conform", cfg!(feature = "conform")),
        ("tls", cfg!(feature = "tls")),
        ("peak", cfg!(feature = "peak")),
        ("kvaser", cfg!(feature = "kvaser")),
        ("gs_usb", cfg!(feature = "gs_usb")),
    ];
    let features: Vec<&str> = features.into_iter().filter_map(|(name, has)| has.then_some(name)).collect();
    let set = std::env::vars_os().filter_map(|(name, _)| name.into_string().ok());
    let mut set: Vec<String> = set.filter(|name| name.starts_with("COFLASH_")).collect();
    set.sort();
    // Only Linux has them; elsewhere they are null.
    let release = fs::read_to_string("/etc/os-release").unwrap_or_default();
    let release = release.lines().find_map(|line| line.strip_prefix("PRETTY_NAME="));
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").ok();
    json!({
        "coflash": env!("COFLASH_VERSION"),
        "features": features,
        "system": std::env::consts::OS,
        "processor": std::env::consts::ARCH,
        "release": release.map(|name| name.trim_matches('"')),
        "kernel": kernel.as_deref().map(str::trim),
        "configuration": crate::config::find(context.config.clone()),
        "environment": set,
    })
}

/// A member of the archive.
struct Text {
    name: String,
    about: &'static str,
    text: String,
}

#[derive(Default)]
struct Archive {
    members: Vec<Text>,
}

impl Archive {
    /// Adds a text, without the secrets of URLs.
    fn add(&mut self, name: String, about: &'static str, text: String) {
        self.members.push(Text { name, about, text: without_urls(&text) });
    }

    /// Adds the files of a run.
    fn run(&mut self, folder: &Path) -> Result<(), Failure> {
        let [report, events, log, trace] = FILES.map(|file| folder.join(file));
        let text = fs::read_to_string(&report).map_err(|error| Failure::unreadable(&report, &error))?;
        let document = serde_json::from_str(&text).ok().filter(Value::is_object);
        let mut document = document.ok_or_else(|| Failure::file(&report, "is not the report of a run"))?;
        let command = document["command"].as_str().unwrap_or_default();
        let shows_contents = command.split(' ').any(|word| SHOW_CONTENTS.contains(&word));
        if shows_contents {
            document["result"] = Value::Null;
        }
        let run = folder.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let run =
            if is_name(&format!("{run}-{}", FILES[1])) { run } else { format!("run-{}", self.members.len()) };
        let name = |file: &str| format!("{run}-{file}");
        let about = "the run: command line, times, bus, result or error, and what was tried";
        self.add(name(FILES[0]), about, format!("{document:#}\n"));
        let is_event = |line: &str| {
            let value = serde_json::from_str::<Value>(line).ok()?;
            value["event"].is_string().then(|| line.to_owned())
        };
        self.add(name(FILES[1]), "the events of the update, one on a line", end(&events, is_event)?);
        // 2026-11-28T09:15:00.000Z  said     words
        let is_message = |line: &str| {
            let (time, rest) = line.split_at_checked(24)?;
            let is_time = time.ends_with('Z') && time.as_bytes()[10] == b'T' && rest.starts_with("  ");
            let is_taken = !rest.starts_with("  frame") && !shows_contents;
            (is_time && is_taken).then(|| line.to_owned())
        };
        self.add(name(FILES[2]), "the messages of the run", end(&log, is_message)?);
        let mut redactor = Redactor::of_contents();
        let without = |line: &str| {
            let line = Line::parse(line).ok().flatten()?;
            Some(Line { frame: redactor.frame(&line.frame), ..line }.to_string())
        };
        self.add(name(FILES[3]), "the frames of the bus", end(&trace, without)?);
        Ok(())
    }
}

/// The end of a file with at most [`MAX_MEMBER`] bytes: of each line what `taken` makes of it.
fn end(path: &Path, mut taken: impl FnMut(&str) -> Option<String>) -> Result<String, Failure> {
    let unreadable = |error: io::Error| Failure::unreadable(path, &error);
    let mut file = BufReader::new(File::open(path).map_err(unreadable)?);
    let (mut text, mut line) = (String::new(), Vec::new());
    loop {
        line.clear();
        if file.read_until(b'\n', &mut line).map_err(unreadable)? == 0 {
            break;
        }
        if let Some(taken) = taken(String::from_utf8_lossy(&line).trim_end()) {
            text.push_str(&taken);
            text.push('\n');
        }
        // Cut seldom, so that each byte is moved once.
        if text.len() > 2 * MAX_MEMBER {
            cut(&mut text);
        }
    }
    cut(&mut text);
    Ok(text)
}

/// Cuts whole lines off the front, so that [`MAX_MEMBER`] bytes or fewer are left.
fn cut(text: &mut String) {
    let Some(over) = text.len().checked_sub(MAX_MEMBER).filter(|over| *over > 0) else { return };
    let at = text.as_bytes()[over - 1..].iter().position(|byte| *byte == b'\n');
    let at = at.map_or(text.len(), |at| over + at);
    text.drain(..at);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_text_is_cut_between_lines() {
        let line = "0123456789abcde\n";
        let mut text = line.repeat(MAX_MEMBER / line.len());
        cut(&mut text);
        assert_eq!(text.len(), MAX_MEMBER);
        text.push_str("the end\n");
        cut(&mut text);
        assert_eq!(text.len(), MAX_MEMBER - line.len() + "the end\n".len());
        assert!(text.starts_with(line) && text.ends_with("e\nthe end\n"));
        let mut one = "a".repeat(MAX_MEMBER + 1);
        cut(&mut one);
        assert_eq!(one, "");
    }
}
