//! The changes that no test notices, and why.

/// Bits that do not overlap: or, exclusive or and sum are the same.
const DISJOINT: &str = "The bits of both sides do not overlap.";
/// `boot_core::resume::HAS_ROOM` is a constant, and true in a bootloader without sealed images.
const HAS_ROOM: &str = "A constant that is true where this code is built.";

/// The file, the change as cargo-mutants prints it behind the place, and the reason. A change that
/// stands several times in one function has one entry.
pub const REASONS: &[(&str, &str, &str)] = &[
    (
        "boot-core/src/bootloader.rs",
        "replace && with || in <impl Objects for Bootloader<'_, F, P, PROGRAMS>>::second_server",
        "Without the server its COB-IDs cannot be written, so the channel is none in either case.",
    ),
    (
        "boot-core/src/bootloader.rs",
        "replace <impl Objects for Bootloader<'_, F, P, PROGRAMS>>::has_second_server -> bool with true",
        HAS_ROOM,
    ),
    (
        "boot-core/src/bootloader.rs",
        "replace match guard resume::HAS_ROOM with true in <impl Objects for Bootloader<'_, F, P, PROGRAMS>>::read",
        HAS_ROOM,
    ),
    (
        "boot-core/src/control/mod.rs",
        "replace + with - in Downloader<'b, P, PROGRAMS>::check_stored",
        "Behind a program that is shorter than its label the flash is erased, which is no label.",
    ),
    (
        "boot-core/src/control/transfer.rs",
        "replace > with >= in Downloader<'_, P, PROGRAMS>::download_start",
        "With one program there is no other whose download could have ended this one.",
    ),
    (
        "boot-core/src/intake/judge.rs",
        "replace < with <= in Judge<'_>::check_place",
        "The address behind a region is the first of the next one, which is also secured or the program's own.",
    ),
    ("boot-core/src/queue.rs", "replace | with ^ in Queue<'b>::word", DISJOINT),
    (
        "boot-core/src/store/journal.rs",
        "replace > with >= in Journal::latest",
        "It also reads the header, which has the tag of no key.",
    ),
    (
        "boot-core/src/store/journal.rs",
        "replace < with <= in Journal::collect",
        "It also reads the word behind the last record, which is blank or a header: the tag of no key.",
    ),
    (
        "boot-core/src/store/journal.rs",
        "replace > with >= in Journal::append",
        "No sector's size is a multiple of a slot's, so a slot never ends with its region.",
    ),
    ("boot-core/src/store/mod.rs", "replace | with ^ in Key::tag", DISJOINT),
    ("boot-core/src/store/record.rs", "replace | with ^ in ProgramRecord::from_value", DISJOINT),
    ("boot-core/src/store/record.rs", "replace | with ^ in ProgramRecord::value", DISJOINT),
    (
        "boot-core/src/stored_version.rs",
        "replace < with <= in StoredVersion::step",
        "It looks at one more byte in each step, which the next step looks at again.",
    ),
    ("boot-core/src/intake/block_file.rs", "replace | with ^ in BlockFile::push", DISJOINT),
    ("boot-core/src/intake/ihex.rs", "replace | with ^ in Hex::push", DISJOINT),
];
