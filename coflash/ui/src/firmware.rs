//! The firmware file that the user dropped on the page.

use std::fmt::Display;
use std::path::Path;
use std::sync::Arc;

use shared_abi::block_file::ProgramVersion;

use super::advice;
use super::state::{Firmware, Notice, Seal, Settings};
use coflash_core::file::sealed::show::flags;
use coflash_core::file::sealed::SealedFile;
use coflash_core::file::{ram_image, Program, Target};
use coflash_core::update::{self, ContentFault, Judging, Marks, Payload, Reading};

/// The most bytes of a file: an ELF file of the largest program with all debug information.
pub(super) const FILE_MAX: usize = 32 * 1024 * 1024;
/// The longest name that is shown.
const NAME_MAX: usize = 120;

/// A file that was read and checked.
#[derive(Debug)]
pub(super) struct Loaded {
    /// The file itself: after a change of the settings it is converted again.
    pub(super) bytes: Arc<Vec<u8>>,
    pub(super) program: Payload,
    pub(super) shown: Firmware,
}

/// Reads a file and makes a program of it; a sealed image stays unchanged.
pub(super) fn load(bytes: Arc<Vec<u8>>, name: &str, settings: &Settings) -> Result<Loaded, Notice> {
    let name = printable(name);
    if bytes.len() > FILE_MAX {
        let words = format!("{name}: {} bytes are more than any program has", bytes.len());
        return Err(Notice::failed(words, "choose the firmware file itself"));
    }
    // The update itself judges the rest, but does not know the board.
    let reading =
        Reading::new(settings.program).board(settings.board).judging(Judging::Handoff).inspect(true);
    let read = reading.read(Path::new(&name), &bytes).map_err(|fault| notice(&name, fault))?;
    let size = bytes.len();
    let shown = match &read.payload {
        Payload::Program(program) => of_program(program, &read, size, name),
        Payload::Sealed(file) if !read.payload.is_bootloader() => {
            of_sealed(file, read.payload.marks(), size, name)
        }
        new => of_bootloader(new, size, name),
    };
    Ok(Loaded { bytes, program: read.payload, shown })
}

/// Why a file cannot be taken.
fn notice(name: &str, fault: ContentFault) -> Notice {
    let anew = "choose the firmware file itself: Intel HEX, S-record, ELF, block file or sealed image; \
                a raw binary (.bin) needs a board that says where it belongs";
    let of = |what: &dyn Display| format!("{name}: {what}");
    match fault {
        ContentFault::Bootloader(fault) => Notice::failed(of(&fault), ram_image::Fault::ADVICE),
        ContentFault::Sealed(refusal) => Notice::failed(of(&refusal), advice::on_page(&refusal.advice())),
        ContentFault::Judged(fault) => Notice::failed(of(&fault), advice::on_page(&fault.advice())),
        ContentFault::NoProgram { programs, .. } => {
            Notice::failed(fault.to_string(), format!("its programs are 1 to {programs}"))
        }
        fault if fault.is_without_address() => {
            Notice::failed(of(&"a raw binary does not contain its address"), "choose the board")
        }
        ContentFault::File(error) => Notice::failed(advice::of_file(&error.of(name)), anew),
        fault => Notice::failed(of(&fault), anew),
    }
}

/// A program.
fn of_program(program: &Program, read: &update::Loaded, size: usize, name: String) -> Firmware {
    let label = label_of(program);
    let inspection = read.inspection.as_ref();
    Firmware {
        size,
        inspection: inspection.map(|it| advice::with_advice(it, it.advice())).unwrap_or_default(),
        program_size: program.size(),
        crc: program.crc(),
        marks: read.payload.marks(),
        vendor_id: label.as_ref().map(|label| label.0),
        product_code: label.as_ref().map(|label| label.1),
        version: inspection
            .and_then(|inspection| inspection.software_version.clone())
            .or(label.and_then(|label| label.2)),
        left_out: read.left_out,
        is_bootloader: false,
        seal: None,
        name,
    }
}

/// A bootloader, which takes the place of that of the device.
fn of_bootloader(new: &Payload, size: usize, name: String) -> Firmware {
    let target = new.target();
    let version = new.bootloader().map(|version| version.to_string());
    Firmware {
        size,
        inspection: format!(
            "a bootloader: it renews that of the device, and the program stays ({})",
            version.as_deref().unwrap_or_default()
        ),
        program_size: new.size(),
        crc: new.crc(),
        marks: new.marks(),
        vendor_id: target.map(|target| target.vendor_id),
        product_code: target.map(|target| target.product_code),
        version,
        left_out: 0,
        is_bootloader: true,
        seal: None,
        name,
    }
}

/// A sealed image. Only the device's keys decrypt it.
fn of_sealed(file: &SealedFile, marks: Marks, size: usize, name: String) -> Firmware {
    let (head, sealed, target) = (file.head(), file.parts(), file.target());
    Firmware {
        size,
        inspection: sealed.to_string(),
        program_size: head.size(),
        crc: head.crc(),
        marks,
        vendor_id: Some(target.vendor_id),
        product_code: Some(target.product_code),
        version: Some(ProgramVersion(head.version()).to_string()),
        left_out: 0,
        is_bootloader: false,
        seal: Some(Seal {
            program: head.program(),
            counter: head.counter(),
            signed_by: sealed.signers(),
            opened_by: sealed.recipients().map(|recipient| recipient.key_id()).collect(),
            flags: flags(head.flags()).collect(),
        }),
        name,
    }
}

/// The target of the program: vendor-ID, product code and version, from the file or from the label
/// after the vectors.
fn label_of(program: &Program) -> Option<(u32, u32, Option<String>)> {
    if let [Some(Target { vendor_id, product_code }), _] = program.targets() {
        return Some((vendor_id, product_code, program.release().map(|release| release.version.to_string())));
    }
    let label = program.label()?;
    Some((label.vendor_id, label.product_code, Some(ProgramVersion(label.version).to_string())))
}

/// A name from outside as safe text: one line of limited length, without control or direction
/// characters.
pub(super) fn printable(name: &str) -> String {
    let base = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let visible = |c: char| if c.is_alphanumeric() || c.is_ascii_graphic() || c == ' ' { c } else { '_' };
    let name: String = base.chars().take(NAME_MAX).map(visible).collect();
    if name.trim().is_empty() {
        "the file".to_string()
    } else {
        name
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(bytes: &[u8], name: &str) -> String {
        match load(Arc::new(bytes.to_vec()), name, &Settings::default()) {
            Ok(loaded) => format!("{:?}", loaded.shown),
            Err(notice) => notice.words,
        }
    }

    #[test]
    fn what_is_no_firmware_is_refused_with_its_name() {
        assert_eq!(words(b"", "a.hex"), "a.hex: is empty");
        assert!(words(b"<!doctype html><p>404", "app.hex").starts_with("app.hex: is not a firmware file"));
        assert!(words(&[0; 100], "app.bin").contains("a raw binary does not contain its address"));
        assert!(words(b":020000040801F1\n", "app.hex").starts_with("app.hex: "));
    }

    /// Four bytes of Intel HEX at 0802_0000h; the CRC is the output of GNU `gzip` for EFh BEh ADh
    /// DEh.
    #[test]
    fn a_program_is_read_and_a_board_judges_its_place() {
        let hex = b":020000040802F0\n:04000000EFBEADDEC4\n:00000001FF\n".to_vec();
        let loaded = load(Arc::new(hex.clone()), "../x/app.hex", &Settings::default()).unwrap();
        assert_eq!((loaded.shown.name.as_str(), loaded.shown.program_size), ("app.hex", 4));
        assert!(loaded.shown.inspection.starts_with("Intel HEX, well-formed"), "{}", loaded.shown.inspection);
        assert_eq!(loaded.shown.vendor_id, None);
        let board = Settings { board: Some(shared_abi::layout::DEFAULT), program: 1 };
        assert!(load(Arc::new(hex), "app.hex", &board).is_ok());
        let outside = b":020000040800F2\n:04000000EFBEADDEC4\n:00000001FF\n".to_vec();
        let refused = load(Arc::new(outside), "app.hex", &board).unwrap_err();
        assert!(refused.words.starts_with("app.hex"), "{}", refused.words);
        let raw = load(Arc::new(vec![1, 2, 3, 4]), "app.bin", &board).unwrap();
        assert_eq!(raw.shown.program_size, 4);
        let two = Settings { program: 9, ..board };
        assert!(load(Arc::new(vec![1, 2, 3, 4]), "app.bin", &two)
            .unwrap_err()
            .words
            .contains("no program 9"));
    }

    #[test]
    fn a_bootloader_is_known_by_its_header() {
        let mut bytes = b"CBI2".to_vec();
        for word in [0, 64, 4, 0x2000_0000, 0x2001_FFC0, 1, 0, 7, 1, 2, 0, 0x0001_0003, 0, 0, 0, 5] {
            bytes.extend(u32::to_le_bytes(word));
        }
        let words = words(&bytes, "new.bin");
        assert!(words.starts_with("new.bin: is a bootloader without a CRC"), "{words}");
        let crc = coflash_core::file::checksum::CRC.checksum(&bytes[8..]);
        bytes[4..8].copy_from_slice(&crc.to_le_bytes());
        let loaded = load(Arc::new(bytes), "new.bin", &Settings::default()).unwrap();
        assert!(loaded.program.is_bootloader());
        let Firmware { crc: shown, vendor_id, product_code, version, .. } = loaded.shown;
        assert_eq!((shown, vendor_id, product_code), (crc, Some(1), Some(2)));
        assert_eq!(version.as_deref(), Some("1.3"));
    }

    #[test]
    fn a_name_is_one_line_of_text() {
        assert_eq!(printable("a/b\\c.hex"), "c.hex");
        assert_eq!(printable("a\n\u{202E}b"), "a__b");
        assert_eq!(printable("\u{7}").len(), 1);
        assert_eq!(printable("  "), "the file");
        assert_eq!(printable(&"x".repeat(500)).len(), NAME_MAX);
    }
}
