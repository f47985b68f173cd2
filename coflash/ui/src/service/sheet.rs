//! A report in HTML: of one device, or of the machine. A browser prints it on A4, or as PDF, and it has a place to sign.

use std::collections::BTreeMap;

use coflash_core::file::inspect::Date;
use coflash_core::machine::{version, Entry};
use coflash_core::update::Payload;

use super::message::Message;
use super::report::{Kind, Of, Report};
use super::row::{headline, Row, RowState, Step};
use super::setup::Origin;
use super::words::{filled, Language};

/// The page. It has keys of the table in braces, and with `=` the values of the report.
pub(super) const PAGE: &str = include_str!("page/sheet.html");
/// What it may load: nothing. The station has one script that has it printed.
pub(super) const POLICY: &str = "default-src 'none'; style-src 'unsafe-inline'; script-src 'self'";

/// The files of a report, each with its ending.
pub(super) fn contents(report: &Report) -> Vec<(&'static str, String)> {
    let table = (report.kind != Kind::Machine).then(|| ("csv", report.csv()));
    [("html", html(report))].into_iter().chain(table).collect()
}

/// A page that needs no other file, in the language of the user.
pub(super) fn html(report: &Report) -> String {
    let Report { rows, of, kind } = report;
    let Of { date, entered, service, adapter, tool, missing } = &**of;
    let language = entered.language;
    let text = Text(language);
    let (title, result) = match (kind, rows.first()) {
        (Kind::Begun, _) => ("report-title", "report-begun"),
        (Kind::Device, Some(row)) if row.interrupted.is_some() && row.state == RowState::Has => {
            ("report-title", "report-resumed")
        }
        (Kind::Device, Some(row)) => ("report-title", row.outcome()),
        (Kind::Device, None) | (Kind::Machine, _) => ("title", headline(rows).0),
    };
    let (file, sums) = match service.origin {
        Origin::Job => ("verified-job", "report-job-sums"),
        _ => ("verified-package", "report-package-sums"),
    };
    let is_bad = |row: &Row| matches!(row.state, RowState::Failed | RowState::Waiting);
    let mark = if rows.iter().any(is_bad) { "bad" } else { "good" };
    let (manifest, (sha, crc)) = (service.package.manifest(), service.package.checksums());
    let named = [manifest.name.as_deref(), manifest.release.as_deref(), Some(&service.file)];
    let missing = missing.iter().map(|it| language.message(it)).collect::<Vec<_>>().join(" ");
    let interrupted = rows.iter().filter_map(|row| row.interrupted.as_deref()).collect::<Vec<_>>().join(" ");
    let signature = escaped(&of.signature(language));
    let values: BTreeMap<&str, String> = [
        ("=code", language.code().to_owned()),
        ("=policy", POLICY.to_owned()),
        ("=style", include_str!("page/sheet.css").to_owned()),
        ("=title", text.of(title)),
        ("=result", text.of(result)),
        ("=mark", mark.to_owned()),
        ("=date", Date(*date).to_string()),
        ("=operator", escaped(&entered.operator)),
        ("=order", escaped(&entered.order)),
        ("=device_number", escaped(&entered.device_number)),
        ("=origin", text.of(service.origin.key())),
        ("=package", escaped(&named.into_iter().flatten().collect::<Vec<_>>().join(" "))),
        ("=sums", text.of(sums)),
        ("=sha", sha.to_owned()),
        ("=crc", hex(crc)),
        ("=signature", if signature.is_empty() { "–".to_owned() } else { signature }),
        ("=missing", text.fact("report-missing", &missing) + &text.fact("report-interrupted", &interrupted)),
        ("=adapter", escaped(adapter)),
        ("=tool", escaped(tool)),
        ("=devices", rows.iter().map(|row| text.device(row)).collect()),
        ("=troubles", rows.iter().map(|row| text.troubles(row)).collect()),
        ("=programs", service.package.programs().map(program).collect()),
        ("=file", text.of(file)),
        ("=identified", text.good(rows, of, |step, _, _| is_new(step.state).then(|| step.is_begun()))),
        ("=good", text.good(rows, of, |step, _, _| has_shown_crc(step).then(|| is_there(step)))),
        ("=tried", text.good(rows, of, |step, entry, _| is_tried(step, entry))),
        ("=sealed", text.good(rows, of, |step, _, program| is_authentic(step, program))),
    ]
    .into();
    filled(PAGE, |name| values.get(name).cloned().unwrap_or_else(|| text.of(name)))
}

/// Whether the program was to be written.
const fn is_new(state: RowState) -> bool {
    matches!(state, RowState::Updated | RowState::Failed)
}

/// Whether the program is in its device.
const fn is_there(step: &Step) -> bool {
    matches!(step.state, RowState::Updated | RowState::Has)
}

/// Whether the program has passed its trial; `None` if it had none, which a dialect may not have.
fn is_tried(step: &Step, entry: &Entry) -> Option<bool> {
    match step.state {
        RowState::Updated => step.tried.then_some(true),
        RowState::Failed => entry.trial_run.then_some(false),
        _ => None,
    }
}

/// Whether the device has taken a sealed program.
fn is_authentic(step: &Step, program: &Payload) -> Option<bool> {
    (is_new(step.state) && matches!(program, Payload::Sealed(_))).then(|| is_there(step))
}

/// A program of the file, with what identifies it.
fn program((entry, program): (&Entry, &Payload)) -> String {
    let version = version(program).unwrap_or_else(|| "–".to_owned());
    let sum = format!("<code>{}</code>", escaped(&entry.sha256));
    line(&[escaped(&entry.name), escaped(&version), program.size().to_string(), hex(program.crc()), sum])
}

/// Whether the CRC of a program counts: not if it was left out, or written in a device that was not asked.
fn has_shown_crc(step: &Step) -> bool {
    match step.state {
        RowState::LeftOut => false,
        RowState::Updated => step.crc.is_some(),
        _ => true,
    }
}

/// A line of a table.
fn line(cells: &[String]) -> String {
    format!("<tr><td>{}</td></tr>\n", cells.join("</td><td>"))
}

/// The texts of a report in HTML.
#[derive(Clone, Copy)]
struct Text(Language);

impl Text {
    fn of(self, key: &'static str) -> String {
        escaped(self.0.text(key))
    }

    /// A line that is only there if there is something to say.
    fn fact(self, key: &'static str, value: &str) -> String {
        let line = || format!("<tr><th>{}</th><td>{}</td></tr>\n", self.of(key), escaped(value));
        if value.is_empty() {
            String::new()
        } else {
            line()
        }
    }

    /// Of how many of the programs something is good, among those of which it was asked.
    fn good(self, rows: &[Row], of: &Of, is_good: fn(&Step, &Entry, &Payload) -> Option<bool>) -> String {
        let is_good = |step: &Step| {
            let (entry, program) = of.service.package.programs().nth(step.entry)?;
            is_good(step, entry, program)
        };
        let asked: Vec<bool> = rows.iter().flat_map(|row| &row.steps).filter_map(is_good).collect();
        let good = asked.iter().filter(|is_good| **is_good).count();
        if asked.is_empty() {
            return "–".to_owned();
        }
        let count = Message::new("report-count").value("count", good).value("all", asked.len());
        escaped(&self.0.message(&count))
    }

    /// A line for each program of a device, the first one with node-ID, name and 1018h.
    fn device(self, row: &Row) -> String {
        let part = |part: Option<u32>| part.map_or_else(|| self.of("report-unknown"), hex);
        let node =
            row.node.map_or_else(|| self.of("missing-device"), |it| format!("{} {it}", self.of("node")));
        let name = row.name.as_ref().map_or(String::new(), |name| format!(" · {}", escaped(name)));
        let [vendor, product, revision, serial] = row.identity.map(part);
        let (of_serial, of_identity) = (self.of("serial"), self.of("identity"));
        let device = format!(
            "<strong>{node}</strong>{name}<br>{of_serial}: {serial}<br>\
             <small>{of_identity}: {vendor} / {product} / {revision}</small>",
        );
        if let Some(program) = &row.missing {
            let none = String::new;
            return line(&[node, escaped(program), none(), none(), none(), self.of(row.outcome())]);
        }
        let steps = row.steps.iter().enumerate().map(|(at, step)| {
            let from = step.from.as_deref().unwrap_or_else(|| self.0.text("no-program"));
            let result = match step.state {
                RowState::Failed if row.steps.len() == 1 => row.outcome(),
                RowState::Has if row.interrupted.is_some() => "report-resumed",
                RowState::Has => "report-had",
                RowState::Waiting => "report-begun",
                state => state.into(),
            };
            let device = if at == 0 { &*device } else { "" }.to_owned();
            let crc = step.crc.map_or_else(|| "–".to_owned(), hex);
            line(&[device, escaped(&step.program), escaped(from), escaped(&step.to), crc, self.of(result)])
        });
        steps.collect()
    }

    fn troubles(self, row: &Row) -> String {
        let node = row.node.map_or(String::new(), |node| format!(": {} {node}", self.of("node")));
        let trouble = |(program, trouble, left): (&str, &Message, Option<&'static str>)| {
            let of = if row.steps.len() > 1 { format!(" · {}", escaped(program)) } else { String::new() };
            let left = left.map_or(String::new(), |key| format!(" {}", self.of(key)));
            format!(
                "<h3>{}{node}{of}</h3>\n<p>{}{left}</p>\n<p class=\"detail\" lang=\"en\">{}</p>\n",
                self.of("what-happened"),
                escaped(&self.0.message(trouble)),
                escaped(&trouble.original()),
            )
        };
        row.troubles().into_iter().map(trouble).collect()
    }
}

fn hex(number: u32) -> String {
    format!("{number:08X}h")
}

/// Text for HTML.
fn escaped(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    text.replace('"', "&quot;").replace('\'', "&#39;")
}
