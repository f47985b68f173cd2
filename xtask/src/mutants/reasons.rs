//! The changes that no test notices, and why.

/// Bits that do not overlap: or, exclusive or and sum are the same.
const DISJOINT: &str = "The bits of both sides do not overlap.";
/// The tests of the built firmware in the emulator run it (tests/tests/reentry.rs, application.rs).
const ON_CHIP: &str = "It stands for the chip alone, where the tests in the emulator run it.";
/// `boot_core::resume::HAS_ROOM` is a constant, and true in a bootloader without sealed images.
const HAS_ROOM: &str = "A constant that is true where this code is built.";

/// Its default exists only where sealed images do not.
const EMPTY_UNSEALER: &str = "Without sealed images there is nothing in it; with them it has no default.";

/// `Stream::close` in `boot-core/src/intake/stream.rs`: only data change the flash.
const BEGINS: &str =
    "A stream that begins before its first piece, or begins again, changes nothing: it cannot go on behind a cut.";
/// The bound of a step is a promise about time.
const LONGER: &str =
    "It does more in one step, whose time the tests on the emulated chip bound (tests/tests/sealed.rs).";
/// What stands in the code is what the change puts there.
const BODY: &str = "It is the body of this function.";
const ZERO_BITS: &str = "It moves by 0 bits.";
const PREPARED: &str = "Constants that were not prepared are computed with the first signature.";
const NO_ROOM: &str = "Without input and without room the decoder does nothing.";

/// The file, the change as cargo-mutants prints it behind the place, and the reason. A change that
/// stands several times in one function has one entry.
pub const REASONS: &[(&str, &str, &str)] = &[
    (
        "boot-core/src/bootloader.rs",
        "replace + with - in entry_count",
        "It subtracts 0, or more than there is, with which the table of entries does not compile.",
    ),
    (
        "boot-core/src/control/mod.rs",
        "replace Downloader<'b, P, PROGRAMS>::unsealer_mut -> &mut Unsealer<'b> with Box::leak(Box::new(Default::default()))",
        EMPTY_UNSEALER,
    ),
    (
        "boot-core/src/programmer/mod.rs",
        "replace Programmer<'b>::unsealer_mut -> &mut Unsealer<'b> with Box::leak(Box::new(Default::default()))",
        EMPTY_UNSEALER,
    ),
    (
        "boot-core/src/control/transfer.rs",
        "replace && with || in Downloader<'_, P, PROGRAMS>::take",
        "Without an open session the queue is empty, and in one the refused download ends, which empties it.",
    ),
    (
        "boot-core/src/stored_version.rs",
        "replace < with <= in StoredVersion::step",
        "A mark that begins behind the program has no text in it.",
    ),
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
    ("boot-core/src/store/record.rs", "replace | with ^", DISJOINT),
    ("boot-core/src/store/record.rs", "replace | with ^ in ProgramRecord::from_value", DISJOINT),
    ("boot-core/src/store/record.rs", "replace | with ^ in ProgramRecord::value", DISJOINT),
    (
        "boot-core/src/stored_version.rs",
        "replace < with <= in StoredVersion::step",
        "It looks at one more byte in each step, which the next step looks at again.",
    ),
    ("boot-core/src/intake/block_file.rs", "replace | with ^ in BlockFile::push", DISJOINT),
    ("boot-core/src/intake/ihex.rs", "replace | with ^ in Hex::push", DISJOINT),
    (
        "boot-core/src/intake/mod.rs",
        "replace match guard !bytes.is_empty() with true in Intake::data",
        "No bytes are no event in any format.",
    ),
    (
        "boot-core/src/intake/sealed.rs",
        "delete match arm (true, false) in <impl Format for Sealed>::recognise",
        "The other formats wait for four bytes, too.",
    ),
    ("boot-core/src/intake/stream.rs", "replace && with || in Stream::close", BEGINS),
    ("boot-core/src/intake/stream.rs", "replace > with >= in Stream::close", BEGINS),
    ("boot-core/src/queue.rs", "replace > with >= in Queue<'b>::commit", "Without an open piece it adds no byte."),
    (
        "boot-core/src/resume/present.rs",
        "replace > with >= in Partial::note",
        "At the border both steps have the same size.",
    ),
    ("boot-core/src/programmer/mod.rs", "replace match guard self.unsealer.prepare() with true in Programmer<'b>::step", PREPARED),
    ("boot-core/src/unseal/access.rs", "replace | with ^ in Unsealer<'_>::end", DISJOINT),
    ("boot-core/src/unseal/access.rs", "replace | with ^ in Room::challenge", DISJOINT),
    ("boot-core/src/unseal/access.rs", "replace | with ^ in Room::grant", DISJOINT),
    ("boot-core/src/unseal/image.rs", "replace Unsealer<'_>::prepare -> bool with true", PREPARED),
    ("boot-core/src/unseal/image.rs", "replace + with * in Room::advance", LONGER),
    ("boot-core/src/unseal/image.rs", "replace + with * in Room::unpack", LONGER),
    ("boot-core/src/unseal/image.rs", "replace && with || in Room::unpack", NO_ROOM),
    ("boot-core/src/unseal/image.rs", "replace < with <= in Room::unpack", NO_ROOM),
    (
        "boot-core/src/unseal/image.rs",
        "replace < with > in Room::unpack",
        "The decoder has refused before: with the last input it fills the room, or it fails.",
    ),
    (
        "boot-core/src/unseal/image.rs",
        "replace > with >= in Room::unpack",
        "Without room the decoder does nothing; with room it leaves fewer than the 24 bytes, and behind the end of a \
         signed image it makes no difference whether 24 bytes or 25 are too many.",
    ),
    (
        "boot-core/src/unseal/image.rs",
        "replace < with > in Room::advance",
        "It asks for the size of the head after each piece, and gets the same answer until the piece is complete.",
    ),
    (
        "boot-core/src/unseal/image.rs",
        "replace + with * in Room::judge",
        "The room for the keys is longer, and the zeros behind them are no key.",
    ),
    (
        "boot-core/src/unseal/image.rs",
        "replace + with *",
        "The buffer is larger than needed, which the linker refuses on the chip.",
    ),
    ("shared-abi/src/callgate.rs", "replace << with >>", ZERO_BITS),
    ("shared-abi/src/handoff.rs", "replace << with >>", ZERO_BITS),
    (
        "shared-abi/src/geometry.rs",
        "replace > with < in Region::contains",
        "Bytes of which all lie inside have their address inside, too.",
    ),
    ("shared-abi/src/registers.rs", "replace | with ^ in request_reset", DISJOINT),
    ("shared-abi/src/registers.rs", "replace | with ^ in release_core", DISJOINT),
    ("shared-abi/src/bit_timing.rs", "replace | with ^ in BitTiming::register", DISJOINT),
    ("shared-abi/src/block_file.rs", "replace | with ^ in Control::parse", DISJOINT),
    ("shared-abi/src/callgate.rs", "replace Callgate::find -> Result<Self, CallgateError> with Ok(Default::default())", ON_CHIP),
    ("shared-abi/src/callgate.rs", "replace <impl Enter for u32>::enter -> Option<i32> with None", ON_CHIP),
    ("shared-abi/src/callgate.rs", "replace <impl Enter for u32>::enter -> Option<i32> with Some(0)", ON_CHIP),
    ("shared-abi/src/callgate.rs", "replace <impl Enter for u32>::enter -> Option<i32> with Some(1)", ON_CHIP),
    ("shared-abi/src/callgate.rs", "replace <impl Enter for u32>::enter -> Option<i32> with Some(-1)", ON_CHIP),
    ("shared-abi/src/reentry.rs", "replace put_request with ()", ON_CHIP),
    ("shared-abi/src/reentry.rs", "replace <impl Registers for Hardware>::read -> u32 with 0", ON_CHIP),
    ("shared-abi/src/reentry.rs", "replace <impl Registers for Hardware>::read -> u32 with 1", ON_CHIP),
    ("shared-abi/src/reentry.rs", "replace <impl Registers for Hardware>::write with ()", ON_CHIP),
    ("shared-abi/src/reentry.rs", "replace interrupts_off with ()", ON_CHIP),
    ("canopen/src/frame.rs", "replace | with ^ in <impl embedded_can::Frame for Frame>::new_remote", DISJOINT),
    ("canopen/src/frame.rs", "replace | with ^ in word", DISJOINT),
    ("canopen/src/frame.rs", "replace | with ^", DISJOINT),
    ("canopen/src/emcy.rs", "replace << with >>", ZERO_BITS),
    ("canopen/src/program.rs", "replace | with ^ in FlashStatus::to_word", DISJOINT),
    ("canopen/src/program.rs", "replace | with ^ in region_value", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in Payload::emit", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in Segment::emit", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in BlockSegment::emit", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in BlockEnd::emit", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in Request::emit", DISJOINT),
    ("canopen/src/sdo/wire.rs", "replace | with ^ in Response::emit", DISJOINT),
    ("canopen/src/sdo/server/block_download.rs", "replace | with ^ in SdoServer::initiate_block_download", DISJOINT),
    ("canopen/src/sdo/server/block_upload.rs", "replace | with ^ in SdoServer::initiate_block_upload", DISJOINT),
    ("canopen/src/sdo/server/segmented.rs", "replace | with ^ in SdoServer::download_segment", DISJOINT),
    ("canopen/src/sdo/server/segmented.rs", "replace | with ^ in SdoServer::answer_upload", DISJOINT),
    ("canopen/src/sdo/server/segmented.rs", "replace | with ^ in SdoServer::upload_segment", DISJOINT),
    ("canopen/src/od.rs", "replace Objects::download_end -> Result<(), AbortCode> with Ok(())", BODY),
    ("canopen/src/od.rs", "replace Objects::download_cancel with ()", BODY),
    ("canopen/src/lss.rs", "replace LssDevice::stored -> Poll<Result<(), StoreError>> with Poll::from(Ok(()))", BODY),
    ("canopen/src/slave.rs", "replace SlaveDevice::line_event with ()", BODY),
    ("canopen/src/slave.rs", "replace SlaveDevice::node_id_changed with ()", BODY),
    ("canopen/src/sdo/client/upload.rs", "replace Sink::announce -> Result<(), AbortCode> with Ok(())", BODY),
    ("canopen/src/sdo/client/group.rs", "replace | with ^ in GroupDownload<D>::wait", DISJOINT),
    ("canopen/src/sdo/server/block_upload.rs", "replace | with ^ in Sender::count", DISJOINT),
    ("canopen/src/sdo/server/block_upload.rs", "replace | with ^ in Sender::acknowledged", DISJOINT),
    (
        "canopen/src/sdo/server/mod.rs",
        "replace < with <= in SdoServer::may_answer",
        "With room for one segment it gives one in either case.",
    ),
    ("canopen/src/debugger/mod.rs", "replace > with >= in Debugger<M>::command", "Eight bytes never come here."),
    (
        "canopen/src/debugger/mod.rs",
        "replace > with >= in Debugger<M>::download_data",
        "Before the first byte there is nothing to write.",
    ),
    (
        "coboot-app/src/bootloader.rs",
        "replace Bootloader::program_crc -> u32 with 0",
        ON_CHIP,
    ),
    ("coboot-app/src/bootloader.rs", "replace Bootloader::program_crc -> u32 with 1", ON_CHIP),
    ("coboot-app/src/bootloader.rs", "replace - with + in Bootloader::program_crc", ON_CHIP),
    ("coboot-app/src/bootloader.rs", "replace - with / in Bootloader::program_crc", ON_CHIP),
    ("coboot-app/src/bootloader.rs", "replace | with ^ in Exit::ask", DISJOINT),
    ("coboot-app/src/responder.rs", "replace | with ^ in Responder::request", DISJOINT),
    ("coboot-app/src/responder.rs", "replace << with >> in Responder::download", ZERO_BITS),
    (
        "seal/src/ed25519.rs",
        "replace > with >= in Verification::go_on_with_power",
        "It is about bit 7, which is a one in both exponents.",
    ),
    ("seal/src/ed25519.rs", "replace | with ^ in remainder", DISJOINT),
    (
        "seal/src/lzma.rs",
        "replace == with != in Decoder::symbol",
        "Two tables of the same size, and equal at the beginning, change places for the whole stream.",
    ),
    ("seal/src/lzma.rs", "replace | with ^ in Decoder::distance", DISJOINT),
    ("seal/src/lzma.rs", "replace | with ^ in Decoder::shift", DISJOINT),
    ("seal/src/sha512.rs", "replace ^= with |= in root", "The bit is not set before."),
    ("seal/src/sha512.rs", "replace | with ^ in root", DISJOINT),
    ("seal/src/sha512.rs", "replace | with ^ in constant", DISJOINT),
    ("seal/src/sha512.rs", "replace | with ^ in Sha512::push", DISJOINT),
    (
        "seal/src/sha512.rs",
        "replace | with ^ in Sha512::compress",
        "Where both are set, the left side of the majority is set already.",
    ),
    ("seal/src/wire.rs", "replace | with ^ in word", DISJOINT),
    (
        "seal/src/wire.rs",
        "replace Certificate<'a>::is_empty -> bool with false",
        "A certificate is never empty; the question stands beside its length.",
    ),
    ("seal/src/access.rs", "replace << with >>", ZERO_BITS),
    ("seal/src/wire.rs", "replace << with >>", ZERO_BITS),
    ("seal/src/wire.rs", "replace | with ^", DISJOINT),
    (
        "seal/src/lzma.rs",
        "replace + with *",
        "The tables stand further apart, and none overlaps another: it is RAM that nothing uses.",
    ),
    ("seal/src/sha512.rs", "replace + with * in root", "The number has room for words that stay 0."),
    ("seal/src/sha512.rs", "replace + with * in Sha512::compress", "The list of working variables is longer than needed."),
];
