//! The report of a device: what became of it, in HTML for people and in CSV for programs.

use std::fmt::Write as _;
use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Arc;

use coflash_core::file::inspect::Date;
use serde::Deserialize;

use super::folder::Folder;
use super::message::Message;
use super::row::{Row, RowState, Step};
use super::setup::Origin;
use super::words::Language;

/// The names of the columns. They are the same in each language, so that a table takes all reports.
const COLUMNS: &str = "date,result,node,device,vendor_id,product_code,revision,serial_number,program,from,to,\
                       program_result,error_number,error,operator,order,device_number,package,release,file,adapter,tool";
/// The most characters of what a user enters.
const ENTERED_MAX: usize = 100;

/// What the user has entered.
#[derive(Clone, Debug, Default, Deserialize)]
pub(super) struct Entered {
    pub(super) operator: String,
    pub(super) order: String,
    pub(super) device_number: String,
    pub(super) language: Language,
}

impl Entered {
    /// Whether it can be a part of a report. A barcode reader may send anything.
    pub(super) fn is_text(&self) -> bool {
        let texts = [&self.operator, &self.order, &self.device_number];
        texts.iter().all(|text| text.chars().count() <= ENTERED_MAX && !text.contains(char::is_control))
    }
}

/// What the reports of one update have in common.
#[derive(Clone, Debug)]
pub(super) struct Of {
    /// Seconds since 1970, UTC.
    pub(super) date: u64,
    pub(super) entered: Entered,
    pub(super) origin: Origin,
    /// The name of the machine in the package.
    pub(super) package: Option<String>,
    pub(super) release: Option<String>,
    pub(super) file: String,
    pub(super) adapter: String,
    /// What the machine should have and does not.
    pub(super) missing: Vec<Message>,
}

/// A report.
#[derive(Clone, Debug)]
pub(super) struct Report {
    row: Row,
    of: Arc<Of>,
    /// Whether the update has begun, and nothing more is known.
    is_begun: bool,
}

/// The part of the name of a report about an update that has begun.
const BEGUN: &str = "_begun";

/// Why reports are not saved.
pub(super) fn unsaved(error: &io::Error, folder: &Path) -> Message {
    let is_full = matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded);
    let key = if is_full { "disk-full" } else { "not-saved" };
    Message::new(key).value("folder", folder.display()).detail(error)
}

/// The part of a name that is a device's own.
fn of_device(row: &Row) -> String {
    let node = row.node.map_or(String::new(), |node| format!("_node-{node}"));
    let serial = row.identity[3].map_or(String::new(), |serial| format!("_{serial:08X}h"));
    node + &serial
}

/// Notes which devices have their program from an update that did not end: its report is the latest
/// one.
pub(super) fn note_interrupted(rows: &mut [Row], folder: &Folder) {
    for row in rows {
        // Without its serial number it may be any device.
        let latest = row.identity[3].and_then(|_| folder.latest(&of_device(row), Report::ENDINGS[1]));
        let is_in = |text: &str, step: &Step| text.contains(&step.program) && text.contains(&step.to);
        let is_of = |text: &str| row.steps.iter().all(|step| is_in(text, step));
        let begun = latest.filter(|(name, text)| name.contains(BEGUN) && is_of(text));
        row.interrupted = begun.map(|(name, _)| name);
    }
}

impl Report {
    pub(super) fn new(row: Row, of: Arc<Of>) -> Self {
        Self { row, of, is_begun: false }
    }

    /// The report of an update before its first frame: what is left of one whose computer loses its
    /// power.
    pub(super) fn begun(row: Row, of: Arc<Of>) -> Self {
        Self { row, of, is_begun: true }
    }

    /// The name of its files: date, node-ID and serial number.
    pub(super) fn name(&self) -> String {
        let date = Date(self.of.date).to_string().replace(" UTC", "Z").replace(':', "").replace(' ', "_");
        let begun = if self.is_begun { BEGUN } else { "" };
        format!("{date}{}{begun}", of_device(&self.row))
    }

    /// The endings of its files.
    pub(super) const ENDINGS: [&str; 2] = ["html", "csv"];

    /// The files, each with its ending.
    pub(super) fn contents(&self) -> [(&'static str, String); 2] {
        let [html, csv] = Self::ENDINGS;
        [(html, self.html()), (csv, self.csv())]
    }

    /// Everything that must not be lost, in one line for the terminal.
    pub(super) fn line(&self) -> String {
        let rows = self.cells();
        rows.iter().map(|cells| cells.join("; ")).collect::<Vec<_>>().join("\n")
    }

    /// The cells of a line for each program; of a device that is missing, for the one that it should have.
    fn cells(&self) -> Vec<Vec<String>> {
        let Self { row, of, is_begun } = self;
        let Of { date, entered, package, release, file, adapter, .. } = &**of;
        let word = |state: RowState| match state {
            _ if *is_begun => "begun",
            RowState::Updated => "updated",
            RowState::Has if row.interrupted.is_some() => "resumed",
            RowState::Has => "had",
            _ => "failed",
        };
        let hex = |part: Option<u32>| part.map_or(String::new(), |part| format!("{part:08X}h"));
        let trouble = row.trouble.as_ref();
        let mut head = vec![
            Date(*date).to_string(),
            word(row.state).to_owned(),
            row.node.map_or(String::new(), |node| node.to_string()),
            row.name.clone().unwrap_or_default(),
        ];
        head.extend(row.identity.map(hex));
        let tail = [
            trouble.and_then(|trouble| trouble.number).map_or(String::new(), |it| format!("0x{it:08X}")),
            trouble.and_then(|trouble| trouble.detail.clone()).unwrap_or_default(),
            entered.operator.clone(),
            entered.order.clone(),
            entered.device_number.clone(),
            package.clone().unwrap_or_default(),
            release.clone().unwrap_or_default(),
            file.clone(),
            adapter.clone(),
            format!("coflash {}", env!("CARGO_PKG_VERSION")),
        ];
        let line = |program: [String; 4]| [&head[..], &program, &tail].concat();
        if let Some(program) = &row.missing {
            let (from, to) = (String::new(), String::new());
            return vec![line([program.clone(), from, to, word(row.state).to_owned()])];
        }
        let of_step = |step: &Step| {
            let (from, to) = (step.from.clone().unwrap_or_default(), step.to.clone());
            line([step.program.clone(), from, to, word(step.state).to_owned()])
        };
        row.steps.iter().map(of_step).collect()
    }

    /// CSV (RFC 4180) in UTF-8.
    fn csv(&self) -> String {
        let mut text = format!("{COLUMNS}\r\n");
        for cells in self.cells() {
            let cells: Vec<String> = cells.iter().map(|cell| csv_cell(cell)).collect();
            text += &format!("{}\r\n", cells.join(","));
        }
        text
    }

    /// A page that needs no other file, in the language of the user.
    fn html(&self) -> String {
        let Self { row, of, is_begun } = self;
        let Of { date, entered, origin, package, release, file, adapter, missing } = &**of;
        let language = entered.language;
        let text = |key: &'static str| escaped(language.text(key));
        let unknown = || language.text("report-unknown").to_owned();
        let result = |state: RowState| match state {
            _ if *is_begun => ("bad", "report-begun"),
            RowState::Updated => ("good", "report-good"),
            RowState::Has if row.interrupted.is_some() => ("good", "report-resumed"),
            RowState::Has => ("good", "report-had"),
            _ => ("bad", "report-bad"),
        };
        let hex = |part: Option<u32>| part.map_or_else(unknown, |part| format!("{part:08X}h"));
        let [vendor, product, revision, serial] = row.identity;
        let parts: Vec<String> = [vendor, product, revision].into_iter().map(hex).collect();
        let some = |text: &Option<String>| text.clone().unwrap_or_default();
        let facts: [(&'static str, String); 13] = [
            ("report-date", Date(*date).to_string()),
            ("operator", entered.operator.clone()),
            ("order", entered.order.clone()),
            ("device-number", entered.device_number.clone()),
            ("device", row.name.clone().unwrap_or_else(unknown)),
            ("node", row.node.map_or_else(unknown, |node| node.to_string())),
            ("serial", hex(serial)),
            ("identity", parts.join(" / ")),
            (origin.key(), [&*some(package), &*some(release), file].join(" ").trim().to_owned()),
            ("report-missing", missing.iter().map(|it| language.message(it)).collect::<Vec<_>>().join(" ")),
            ("report-interrupted", some(&row.interrupted)),
            ("report-adapter", adapter.clone()),
            ("report-tool", format!("coflash {}", env!("CARGO_PKG_VERSION"))),
        ];
        let mut page = format!(
            "<!doctype html>\n<html lang=\"{}\">\n<head>\n<meta charset=\"utf-8\">\n\
             <meta http-equiv=\"content-security-policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">\n\
             <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
             <title>{}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n<h1>{}</h1>\n\
             <p class=\"result {}\">{}</p>\n<table>\n",
            language.code(),
            text("report-title"),
            text("report-title"),
            result(row.state).0,
            text(result(row.state).1),
        );
        for (key, value) in facts.iter().filter(|(_, value)| !value.is_empty()) {
            let _ = writeln!(page, "<tr><th>{}</th><td>{}</td></tr>", text(key), escaped(value));
        }
        page += "</table>\n";
        if !row.steps.is_empty() {
            let heads =
                ["program", "from", "to", "report-result"].map(|key| format!("<th>{}</th>", text(key)));
            let _ = writeln!(page, "<table>\n<tr>{}</tr>", heads.concat());
            for step in &row.steps {
                let from = step.from.as_deref().unwrap_or_else(|| language.text("no-program"));
                let cells = [&*step.program, from, &*step.to, language.text(result(step.state).1)];
                let cells = cells.map(|cell| format!("<td>{}</td>", escaped(cell)));
                let _ = writeln!(page, "<tr>{}</tr>", cells.concat());
            }
            page += "</table>\n";
        }
        if let Some(trouble) = &row.trouble {
            let left = row.left.map_or(String::new(), |key| format!(" {}", text(key)));
            let _ = writeln!(
                page,
                "<h2>{}</h2>\n<p>{}{left}</p>\n<p class=\"detail\" lang=\"en\">{}</p>",
                text("what-happened"),
                escaped(&language.message(trouble)),
                escaped(&trouble.original()),
            );
        }
        page += "</body>\n</html>\n";
        page
    }
}

const STYLE: &str = "body{font:16px/1.5 system-ui,sans-serif;max-width:48rem;margin:2rem auto;padding:0 1rem;color:#1b1f24;background:#fff}\
                     table{border-collapse:collapse;width:100%;margin:1rem 0}th,td{text-align:left;vertical-align:top;\
                     padding:.4rem .6rem;border-bottom:1px solid #d0d7de;overflow-wrap:anywhere}th{color:#57606a;font-weight:600}\
                     .result{font-size:1.3rem;font-weight:700;padding:.6rem 1rem;border-radius:8px}\
                     .good{background:#dafbe1;color:#116329}.bad{background:#ffebe9;color:#a40e26}.detail{color:#57606a}";

/// Text for HTML.
fn escaped(text: &str) -> String {
    let text = text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
    text.replace('"', "&quot;").replace('\'', "&#39;")
}

/// A cell of a CSV file. A spreadsheet takes what begins with one of these characters for a formula, and devices
/// and barcodes may have any text: an apostrophe makes it a text.
fn csv_cell(cell: &str) -> String {
    let is_formula = cell.starts_with(['=', '+', '-', '@', '\t', '\r']);
    let cell = if is_formula { format!("'{cell}") } else { cell.to_owned() };
    if cell.contains(['"', ',', '\r', '\n', ';']) {
        format!("\"{}\"", cell.replace('"', "\"\""))
    } else {
        cell
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A device that got its program.
    fn row(node: u8, name: &str) -> Row {
        let step = Step {
            entry: 0,
            program: "drive".to_owned(),
            from: None,
            to: "1.2".to_owned(),
            state: RowState::Updated,
            crc_tells_nothing: false,
        };
        Row {
            node: Some(node),
            name: Some(name.to_owned()),
            identity: [Some(1), Some(2), Some(3), Some(0x100 + u32::from(node))],
            state: RowState::Updated,
            steps: vec![step],
            ..Row::default()
        }
    }

    fn report(name: &str, entered: Entered) -> Report {
        let of = Of {
            date: 1_420_070_400,
            entered,
            origin: Origin::Job,
            package: Some("Press 4".to_owned()),
            release: None,
            file: "press.cpk".to_owned(),
            adapter: "socketcan:can0".to_owned(),
            missing: Vec::new(),
        };
        Report::new(row(5, name), Arc::new(of))
    }

    /// A device names itself as it likes: its report has this as text.
    #[test]
    fn hostile_names_are_text_in_a_report() {
        let entered =
            Entered { operator: "=1+1".to_owned(), order: "a\"b,c".to_owned(), ..Entered::default() };
        let report = report("<script>alert(1)</script>", entered);
        // The date of GNU `date -u -d @1420070400`.
        assert_eq!(report.name(), "2015-01-01_000000Z_node-5_00000105h");
        let [(_, html), (_, csv)] = report.contents();
        assert!(
            !html.contains("<script") && html.contains("&lt;script&gt;alert(1)&lt;/script&gt;"),
            "{html}"
        );
        assert!(csv.contains(",'=1+1,\"a\"\"b,c\","), "{csv}");
        let lines: Vec<&str> = csv.split("\r\n").collect();
        assert_eq!((lines.len(), lines[2]), (3, ""));
        assert_eq!(lines[0].split(',').count(), 22);
    }

    /// The language is that of the user, and the columns of the table are always the same.
    #[test]
    fn a_report_is_in_the_language_of_the_user() {
        let german = report("x", Entered { language: Language::De, ..Entered::default() });
        let english = report("x", Entered::default());
        let html = |report: &Report| report.contents()[0].1.clone();
        assert!(html(&german).contains("lang=\"de\"") && html(&german).contains("Seriennummer"));
        assert!(html(&english).contains("lang=\"en\"") && html(&english).contains("Serial number"));
        // What the programs came from has its name in either language.
        assert!(html(&german).contains("Job-Datei") && html(&english).contains("Job file"));
        assert!(html(&german).contains("<th>Software</th>") && html(&english).contains("<th>Tool</th>"));
        assert_eq!(german.csv(), english.csv());
    }

    #[test]
    fn a_full_disk_is_named() {
        // ENOSPC and ENOTDIR of Linux.
        #[cfg(target_os = "linux")]
        for (code, key) in [(28, "disk-full"), (20, "not-saved")] {
            assert_eq!(unsaved(&io::Error::from_raw_os_error(code), Path::new("/x")).key, key);
        }
        let message = unsaved(&ErrorKind::StorageFull.into(), Path::new("/x"));
        assert!(Language::De.message(&message).contains("/x"));
    }
}
