//! The report of a device: what became of it, in HTML for people (`sheet`) and in CSV for programs; and that of the
//! machine, one sheet to sign.

use std::io::{self, ErrorKind};
use std::path::Path;
use std::sync::Arc;

use coflash_core::file::inspect::Date;
use coflash_core::machine::Signer;
use coflash_core::update::Payload;
use serde::Deserialize;

use super::folder::Folder;
use super::message::Message;
use super::row::{Row, RowState, Step};
use super::setup::{Origin, Service};
use super::words::Language;

/// The names of the columns. They are the same in each language, so that a table takes all reports.
const COLUMNS: &str = "date,result,node,device,vendor_id,product_code,revision,serial_number,program,from,to,\
                       program_result,error_number,error,operator,order,device_number,package,release,file,adapter,tool,\
                       device_crc,program_crc,program_sha256,file_crc,file_sha256,signature";
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
    pub(super) service: Service,
    pub(super) adapter: String,
    /// The tool, with its version and its commit.
    pub(super) tool: String,
    /// What the machine should have and does not.
    pub(super) missing: Vec<Message>,
}

/// What a report is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// A device whose update has begun, and nothing more is known.
    Begun,
    Device,
    /// All devices.
    Machine,
}

/// A report.
#[derive(Clone, Debug)]
pub(super) struct Report {
    pub(super) rows: Vec<Row>,
    pub(super) of: Arc<Of>,
    pub(super) kind: Kind,
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
        let cell = |text: &str| format!(",{},", csv_cell(text));
        let is_of_step =
            |line: &str, step: &Step| line.contains(&cell(&step.program)) && line.contains(&cell(&step.to));
        let is_in = |text: &str, step: &Step| text.lines().any(|line| is_of_step(line, step));
        let is_of = |text: &str| row.steps.iter().all(|step| is_in(text, step));
        let begun = latest.filter(|(name, text)| name.contains(BEGUN) && is_of(text));
        row.interrupted = begun.map(|(name, _)| name);
    }
}

impl Of {
    /// Who has signed the package, and whether that was checked.
    pub(super) fn signature(&self, language: Language) -> String {
        let Service { package, origin, .. } = &self.service;
        let line = |signer: &Signer| {
            let root = signer.certificate().map_or(String::new(), |by| format!(" ({:08X}h)", by.root_id()));
            let is_known = matches!(origin, Origin::Trusted(known) if known.contains(signer));
            let checked = language.text(if is_known { "signature-good" } else { "signature-unknown" });
            format!("{} {:08X}h{root}: {checked}", language.text("signer"), signer.key)
        };
        match (origin, package.signers()) {
            // Nobody can sign one.
            (Origin::Job, _) => String::new(),
            (_, []) => language.text("signature-none").to_owned(),
            (_, signers) => signers.iter().map(line).collect::<Vec<_>>().join("; "),
        }
    }
}

impl Report {
    /// The endings of its files.
    pub(super) const ENDINGS: [&str; 2] = ["html", "csv"];

    /// The reports of an update: one for each device that has a node-ID and was not left out, and that of the machine.
    pub(super) fn of_all(rows: &[Row], of: &Arc<Of>) -> Vec<Self> {
        let report = |rows, kind| Self { rows, of: of.clone(), kind };
        let of_node = rows.iter().filter(|row| row.node.is_some() && row.state != RowState::LeftOut);
        let devices = of_node.map(|row| report(vec![row.clone()], Kind::Device));
        devices.chain([report(rows.to_vec(), Kind::Machine)]).collect()
    }

    /// The report of an update before its first frame: what is left of one whose computer loses its
    /// power.
    pub(super) fn begun(row: Row, of: Arc<Of>) -> Self {
        Self { rows: vec![row], of, kind: Kind::Begun }
    }

    /// The name of its files: date, and node-ID and serial number of the device.
    pub(super) fn name(&self) -> String {
        let date = Date(self.of.date).to_string().replace(" UTC", "Z").replace(':', "").replace(' ', "_");
        let device = self.rows.first().map_or(String::new(), of_device);
        match self.kind {
            Kind::Begun => format!("{date}{device}{BEGUN}"),
            Kind::Device => format!("{date}{device}"),
            Kind::Machine => format!("{date}_machine"),
        }
    }

    /// Everything that must not be lost, in one line for the terminal: the machine is its devices.
    pub(super) fn line(&self) -> String {
        let rows = if self.kind == Kind::Machine { vec![vec![self.name()]] } else { self.cells() };
        rows.iter().map(|cells| cells.join("; ")).collect::<Vec<_>>().join("\n")
    }

    /// The cells of a line for each program; of a device that is missing, for the one that it should have.
    fn cells(&self) -> Vec<Vec<String>> {
        self.rows.iter().flat_map(|row| self.cells_of(row)).collect()
    }

    fn cells_of(&self, row: &Row) -> Vec<Vec<String>> {
        let Of { date, entered, service, adapter, tool, .. } = &*self.of;
        let (manifest, (sha, crc)) = (service.package.manifest(), service.package.checksums());
        let word = |state: RowState| match state {
            RowState::LeftOut => "left out",
            _ if self.kind == Kind::Begun => "begun",
            RowState::Updated => "updated",
            RowState::Has if row.interrupted.is_some() => "resumed",
            RowState::Has => "had",
            _ => "failed",
        };
        let hex = |part: Option<u32>| part.map_or(String::new(), |part| format!("{part:08X}h"));
        let mut head = vec![
            Date(*date).to_string(),
            word(row.state).to_owned(),
            row.node.map_or(String::new(), |node| node.to_string()),
            row.name.clone().unwrap_or_default(),
        ];
        head.extend(row.identity.map(hex));
        let tail = |trouble: Option<&Message>| {
            [
                trouble.and_then(|trouble| trouble.number).map_or(String::new(), |it| format!("0x{it:08X}")),
                trouble.and_then(|trouble| trouble.detail.clone()).unwrap_or_default(),
                entered.operator.clone(),
                entered.order.clone(),
                entered.device_number.clone(),
                manifest.name.clone().unwrap_or_default(),
                manifest.release.clone().unwrap_or_default(),
                service.file.clone(),
                adapter.clone(),
                tool.clone(),
            ]
        };
        let end = [hex(Some(crc)), sha.to_owned(), self.of.signature(Language::En)];
        let line = |program: [String; 4], trouble: &Option<Message>, sums: [String; 3]| {
            [&head[..], &program, &tail(trouble.as_ref()), &sums, &end].concat()
        };
        if let Some(program) = &row.missing {
            let (from, to) = (String::new(), String::new());
            let program = [program.clone(), from, to, word(row.state).to_owned()];
            return vec![line(program, &row.trouble, Default::default())];
        }
        let of_step = |step: &Step| {
            let (from, to) = (step.from.clone().unwrap_or_default(), step.to.clone());
            let (entry, program) = service.package.programs().nth(step.entry).unzip();
            let sums = [
                hex(step.crc),
                hex(program.map(Payload::crc)),
                entry.map_or(String::new(), |entry| entry.sha256.clone()),
            ];
            line([step.program.clone(), from, to, word(step.state).to_owned()], &step.trouble, sums)
        };
        row.steps.iter().map(of_step).collect()
    }

    /// CSV (RFC 4180) in UTF-8.
    pub(super) fn csv(&self) -> String {
        let mut text = format!("{COLUMNS}\r\n");
        for cells in self.cells() {
            let cells: Vec<String> = cells.iter().map(|cell| csv_cell(cell)).collect();
            text += &format!("{}\r\n", cells.join(","));
        }
        text
    }
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
    use coflash_core::machine::{make, Package, Recipe};

    use super::super::sheet::html;
    use super::*;

    /// A device that got its program.
    fn row(node: u8, name: &str) -> Row {
        let step = Step {
            entry: 0,
            program: "drive".to_owned(),
            to: "1.2".to_owned(),
            state: RowState::Updated,
            crc: Some(0x2144_DF1C),
            ..Step::default()
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

    /// The report of a device, and that of its machine.
    fn reports(name: &str, entered: Entered) -> Vec<Report> {
        let recipe = "[[program]]\nname = 'drive'\nimage = 'program.hex'\nnodes = [5]\n";
        let data = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../core/tests/data"));
        let parts = Recipe::parse(recipe, data).unwrap().parts().unwrap();
        let package = Package::parse(&make(None, None, &parts, &[]).unwrap()).unwrap();
        let folder = std::env::temp_dir().join(format!("coflash-report-{}", std::process::id()));
        let of = Of {
            date: 1_420_070_400,
            entered,
            service: Service::new(package, "press.toml".as_ref(), Origin::Job, &folder).unwrap(),
            adapter: "socketcan:can0".to_owned(),
            tool: "coflash 1.2.3 (0123456789ab)".to_owned(),
            missing: Vec::new(),
        };
        Report::of_all(&[row(5, name)], &Arc::new(of))
    }

    fn report(name: &str, entered: Entered) -> Report {
        reports(name, entered).remove(0)
    }

    /// A device names itself as it likes: its report has this as text.
    #[test]
    fn hostile_names_are_text_in_a_report() {
        let entered =
            Entered { operator: "=1+1".to_owned(), order: "a\"b,c".to_owned(), ..Entered::default() };
        let report = report("<script>alert(1)</script>", entered);
        // The date of GNU `date -u -d @1420070400`.
        assert_eq!(report.name(), "2015-01-01_000000Z_node-5_00000105h");
        let (html, csv) = (html(&report), report.csv());
        assert!(
            !html.contains("<script") && html.contains("&lt;script&gt;alert(1)&lt;/script&gt;"),
            "{html}"
        );
        assert!(csv.contains(",'=1+1,\"a\"\"b,c\","), "{csv}");
        let lines: Vec<&str> = csv.split("\r\n").collect();
        assert_eq!((lines.len(), lines[2]), (3, ""));
        assert_eq!(lines[0].split(',').count(), 28);
    }

    /// The language is that of the user, and the columns of the table are always the same.
    #[test]
    fn a_report_is_in_the_language_of_the_user() {
        let german = report("x", Entered { language: Language::De, ..Entered::default() });
        let english = report("x", Entered::default());
        assert!(html(&german).contains("lang=\"de\"") && html(&german).contains("Seriennummer"));
        assert!(html(&english).contains("lang=\"en\"") && html(&english).contains("Serial number"));
        // What the programs came from has its name in either language.
        assert!(html(&german).contains("Job-Datei") && html(&english).contains("Job file"));
        assert!(html(&german).contains("<th>Software</th>") && html(&english).contains("<th>Tool</th>"));
        assert_eq!(german.csv(), english.csv());
    }

    /// What a quality department asks of it.
    #[test]
    fn the_machine_has_one_sheet_with_what_was_verified_and_a_place_to_sign() {
        let sheet = reports("x", Entered::default()).pop().unwrap();
        assert_eq!(sheet.name(), "2015-01-01_000000Z_machine");
        let page = html(&sheet);
        for part in [
            "coflash 1.2.3 (0123456789ab)",
            "2144DF1Ch",
            "<h2>Verified</h2>",
            "1 of 1 good",
            "class=\"sign\"",
        ] {
            assert!(page.contains(part), "{part}: {page}");
        }
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
