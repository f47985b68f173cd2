//! The records of the ABI, byte for byte: what is written today is the golden copy `records.txt`, and
//! reads as what was written. And the memory map.

use std::mem::{offset_of, size_of};
use std::sync::LazyLock;
use std::task::Poll;

use boot_core::canopen::{BitRate, NodeId};
use boot_core::flash::{run, Flash, FlashFault, Operation};
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord, RenewalRecord, Seal, Value};
use coboot_app::callgate::Callgate;
use seal::key_block::{find, COUNTER, EPOCH, FLAGS, FOR_TESTS, KEKS, KEK_COUNT, KEY, ROOTS, ROOT_COUNT};
use shared_abi::abilities::Abilities;
use shared_abi::boot_report::{BootReport, Reason};
use shared_abi::callgate::{self, Crc32Args, NodeArgs, ProgramArgs, Table};
use shared_abi::geometry::{Region, Sector};
use shared_abi::handoff::{BootInfo, Handoff, ResetCause, SdoBases};
use shared_abi::label::Label;
use shared_abi::nameplate::Nameplate;
use shared_abi::ram_image::{self, Header, Host};
use shared_abi::renewal::{self, of_word, Origin, State, TrialEnd};
use shared_abi::services::{Facts, Services};
use shared_abi::warm_start::{BootRequest, Damage, Owed, StoredNode, TrialStep, WarmStart};

/// What a test says about a change.
pub const FROZEN: &str = "images and devices in the field have it as it was: a new field goes to the end or into a \
    reserved word, a new number is the next free one (shared-abi/src/lib.rs), and the golden copy gets it, too";

/// A record of the golden copy.
pub struct Golden {
    pub name: &'static str,
    /// The structure of coboot.h, if there is one.
    pub structure: Option<&'static str>,
    /// Each field with its offset.
    pub fields: Vec<(&'static str, usize)>,
    pub bytes: Vec<u8>,
}

/// The golden copy.
pub fn golden() -> &'static [Golden] {
    static RECORDS: LazyLock<Vec<Golden>> =
        LazyLock::new(|| include_str!("records.txt").split("\n[").skip(1).map(record).collect());
    &RECORDS
}

fn record(section: &'static str) -> Golden {
    let (head, lines) = section.split_once('\n').unwrap();
    let (name, structure) = head.split_once(']').unwrap();
    let (mut fields, mut bytes) = (Vec::new(), Vec::new());
    for line in lines.lines().filter(|line| !line.is_empty()) {
        let (offset, field, data) = (line[..3].trim(), line[4..22].trim(), &line[23..]);
        assert_eq!(offset.parse(), Ok(bytes.len()), "{name}: {field}");
        fields.push((field, bytes.len()));
        for data in data.split(' ') {
            let (byte, count) = data.split_once('*').unwrap_or((data, "1"));
            let byte = u8::from_str_radix(byte, 16).unwrap();
            bytes.extend(vec![byte; count.parse().unwrap()]);
        }
    }
    Golden { name, structure: structure.strip_prefix(" struct "), fields, bytes }
}

/// The bytes of a structure in RAM. (The host is little-endian, like the chip.)
fn bytes<T: Copy>(value: &T) -> Vec<u8> {
    const { assert!(cfg!(target_endian = "little")) };
    // SAFETY: `T` is one of the ABI's `repr(C)` structures: they have the size of the golden copy.
    unsafe { std::slice::from_raw_parts(std::ptr::from_ref(value).cast(), size_of::<T>()) }.to_vec()
}

/// The structure with these bytes.
pub fn of_bytes<T: Copy>(bytes: &[u8]) -> T {
    assert_eq!(bytes.len(), size_of::<T>());
    // SAFETY: `T` is one of the ABI's structures of integers, and there are as many bytes as it has.
    unsafe { bytes.as_ptr().cast::<T>().read_unaligned() }
}

pub fn word(bytes: &[u8], at: usize) -> u32 {
    of_bytes(&bytes[at..at + 4])
}

/// A flash that takes words.
struct Words(Vec<u8>);

/// The two regions of its journal.
const REGIONS: [Region; 2] = [Region::new(0, 0x200), Region::new(0x200, 0x200)];

impl Words {
    fn with(bytes: &[u8]) -> Self {
        let mut flash = vec![0xFF; 0x400];
        flash[..bytes.len()].copy_from_slice(bytes);
        Self(flash)
    }
}

impl Flash for Words {
    fn read(&self, address: u32, buffer: &mut [u8]) {
        buffer.copy_from_slice(&self.0[address as usize..][..buffer.len()]);
    }

    fn start(&mut self, operation: Operation) -> Result<(), FlashFault> {
        let Operation::Program { address, word } = operation else { panic!("a new device needs no erase") };
        self.0[address as usize..][..4].copy_from_slice(&word.to_le_bytes());
        Ok(())
    }

    fn poll(&mut self) -> Poll<Result<(), FlashFault>> {
        Poll::Ready(Ok(()))
    }

    fn sector_at(&self, _: u32) -> Option<Sector> {
        None
    }
}

/// The bytes of a journal's header and of its first record.
fn journal(key: Key, value: Value) -> [Vec<u8>; 2] {
    let mut flash = Words::with(&[]);
    let mut journal = Journal::open(&flash, REGIONS);
    journal.store(key, value);
    run(&mut flash, |flash, outcome| journal.next(flash, outcome)).unwrap();
    [flash.0[..28].to_vec(), flash.0[28..56].to_vec()]
}

/// What the reader of a record makes of its bytes.
pub fn read(record: &str, bytes: &[u8]) -> String {
    match record.split_once(": ").unwrap_or((record, "")) {
        ("warm-start cell", "mark") => format!("{:?}", of_bytes::<WarmStart>(bytes) == WarmStart::MARKED),
        ("warm-start cell", _) => format!("{:?}", of_bytes::<WarmStart>(bytes).request()),
        ("handoff", _) => format!("{:?}", of_bytes::<Handoff>(bytes).info()),
        ("boot report", _) => {
            let seen = BootReport::parse(&of_bytes(bytes)).map(|it| {
                (BootReport { renewal: 0, ..it }, Reason::from_byte(it.reason), of_word(it.renewal))
            });
            format!("{seen:?}")
        }
        ("nameplate", _) => {
            let plate = Nameplate::parse(&of_bytes(bytes));
            format!("{:?}", plate.map(|it| [it.vendor_id, it.product_code, it.revision, it.serial_number]))
        }
        ("label", _) => {
            let label = Label::parse(&of_bytes(bytes));
            format!("{:?}", label.map(|it| [it.vendor_id, it.product_code, it.version, it.date]))
        }
        ("callgate", _) => {
            format!("{:?}", Callgate::check(of_bytes::<Table>(bytes)).map(|gate| gate.bootloader_version()))
        }
        ("arguments", "CRC") => format!("{:?}", of_bytes::<Crc32Args>(bytes)),
        ("arguments", "node") => format!("{:?}", of_bytes::<NodeArgs>(bytes)),
        ("arguments", _) => format!("{:?}", of_bytes::<ProgramArgs>(bytes)),
        ("RAM image header", _) => {
            let ram = Region::new(0x2000_0000, 0x1_FFC0);
            // It also has an ability of the future.
            let (features, facts) = (Abilities(1 << 15 | 0x0A), 0x0FAC_7500);
            let host = Host { board: 0x1234_5678, services: 2, features, facts };
            format!("{:?}", Header::of_bytes(&of_bytes(bytes)).check(0x4000, ram, host))
        }
        // More of the resident part follows.
        ("services and facts", _) => {
            format!("{:?}", Facts::of_resident(&Words::with(bytes).0, 0x0800_0000, 0x0800_0000))
        }
        ("key block", _) => {
            let roots = [0x11, 0x12].map(|id| find(bytes, ROOTS, ROOT_COUNT, id));
            let keks = [0x21, 0x22].map(|id| find(bytes, KEKS, KEK_COUNT, id));
            format!("{:?}", (roots, keks))
        }
        ("journal", "header") => of_journal(bytes, &named("journal: node-ID and bit rate").bytes),
        ("journal", _) => of_journal(&named("journal: header").bytes, bytes),
        _ => panic!("{record}"),
    }
}

fn of_journal(header: &[u8], record: &[u8]) -> String {
    let flash = Words::with(&[header, record].concat());
    let (journal, key) = (Journal::open(&flash, REGIONS), Key(word(record, 0)));
    let Some(value) = journal.get(&flash, key) else { return "None".to_owned() };
    match key.0 {
        0x1_00FF => format!("{:?}", RenewalRecord::from_value(value)),
        0x1_0001..=0x1_00FE => {
            format!("{:?}", (ProgramRecord::from_value(value), ProgramRecord::partial_of(value)))
        }
        0x3_0000 => {
            let board = NodeParameters { id: NodeId::new(1), bit_rate: BitRate::K10 };
            format!("{:?}", NodeParameters::load(&journal, &flash, board, |_| true))
        }
        _ => format!("{value:08X?}"),
    }
}

/// The record of the golden copy with this name.
pub fn named(name: &str) -> &'static Golden {
    golden().iter().find(|record| record.name == name).unwrap_or_else(|| panic!("no {name}"))
}

/// A record as it is written today, from the golden values, and what its reader sees then.
type Written = (String, Vec<u8>, String);

fn written(name: &str, bytes: Vec<u8>, seen: impl Into<String>) -> Written {
    (name.to_owned(), bytes, seen.into())
}

fn some(value: impl std::fmt::Debug) -> String {
    format!("Some({value:?})")
}

fn warm_starts() -> Vec<Written> {
    let requests = [
        ("answer owed", BootRequest::Owed(Owed { program: 2, value: 3, node_id: 127 })),
        ("stay", BootRequest::Stay),
        ("trial", BootRequest::Trial(254)),
        ("start", BootRequest::Start(1)),
        ("fault", BootRequest::Fault),
        ("power-on", BootRequest::PowerOn),
        ("resume", BootRequest::Resume(2)),
        ("damaged", BootRequest::Damaged(Damage::Facts)),
        ("fresh", BootRequest::Fresh(1)),
        ("confirm", BootRequest::Confirm(1)),
        ("invalidate", BootRequest::Invalidate(254)),
        ("store node", BootRequest::StoreNode(StoredNode::new(127, 1_000_000))),
        ("renewal", BootRequest::Renewal(TrialStep::GivenUp)),
        ("ROM loader", BootRequest::RomLoader),
        ("rescue", BootRequest::Rescue),
    ];
    let cells = requests.map(|(name, request)| {
        written(&format!("warm-start cell: {name}"), bytes(&WarmStart::new(request)), some(request))
    });
    cells.into_iter().chain([written("warm-start cell: mark", bytes(&WarmStart::MARKED), "true")]).collect()
}

/// What the boot stage leaves for a program and for the bootloader.
fn of_boot_stage() -> Vec<Written> {
    let info = BootInfo {
        node_id: 5,
        bit_rate: 125_000,
        program: 1,
        reset_cause: ResetCause::Software,
        trial: true,
        fresh: true,
        bootloader_version: 0x0001_0002,
        serial_number: 0xDEAD_BEEF,
        bootloader_number: Some(2),
        sdo: SdoBases { request: 0x680, response: 0x480 },
        program_date: 1_795_804_215,
        nameplate: true,
    };
    let least = BootInfo { trial: false, fresh: false, nameplate: false, bootloader_number: None, ..info };
    let least = BootInfo { sdo: SdoBases::PREDEFINED, program_date: 0, bit_rate: 0, ..least };
    let report = BootReport {
        reason: 14,
        held_program: 2,
        window_ms: 0x0403,
        owed: Owed { program: 5, value: 3, node_id: 7 },
        returned: 8,
        node_id: 9,
        bit_rate: 4,
        program_reset: 8,
        crash_resets: 12,
        refused: 13,
        renewal: 0,
    };
    let end = (Origin::Confirmed, TrialEnd::Reset(ResetCause::IndependentWatchdog));
    let words = BootReport { renewal: renewal::word(end.0, end.1), ..report }.words();
    vec![
        written("handoff", bytes(&Handoff::new(&info)), some(info)),
        written("handoff: least", bytes(&Handoff::new(&least)), some(least)),
        written("boot report", bytes(&words), some((report, Some(Reason::Compaction), end))),
    ]
}

/// What a program and the callgate have, and what production writes.
fn of_programs() -> Vec<Written> {
    let plate = Nameplate::new(0x123, 0x5EA1_0007, 0x0002_0003, 123_456).words();
    let label = Label::dated(0x319, 0x4007_D151, 0x0001_0203, 1_795_804_215).emit();
    let table = Table {
        magic: callgate::MAGIC,
        abi_version: callgate::ABI_VERSION,
        length: callgate::TABLE_SIZE as u16,
        bootloader_version: 0x0001_0002,
        entry: 0x0800_0211,
    };
    let crc = Crc32Args { address: 0x0802_0000, len: 9, crc: 0xCBF4_3926 };
    let node = NodeArgs { node_id: 42, bit_rate: 250_000 };
    let program = ProgramArgs { number: 2, size: 4096, crc: 5, version: 6, flags: 3 };
    vec![
        written("nameplate", bytes(&plate), some([0x123, 0x5EA1_0007, 0x0002_0003, 123_456])),
        written("label", label.to_vec(), some([0x319, 0x4007_D151, 0x0001_0203, 1_795_804_215])),
        written("callgate", bytes(&table), "Ok(65538)"),
        written("arguments: CRC", bytes(&crc), format!("{crc:?}")),
        written("arguments: node", bytes(&node), format!("{node:?}")),
        written("arguments: program", bytes(&program), format!("{program:?}")),
        written("key block", key_block(), "([Some(16), Some(52)], [Some(88), Some(124)])"),
    ]
}

/// The header of a RAM image, and what it checks in the resident part.
fn of_renewal() -> Vec<Written> {
    let header = Header {
        magic: ram_image::MAGIC,
        crc: 0xA1A2_A3A4,
        length: Header::SIZE,
        size: 0x4000,
        ram_base: 0x2000_0000,
        ram_end: 0x2001_FFC0,
        services: ram_image::SERVICES_VERSION,
        features: Abilities::NONE.with(Abilities::RENEWAL, true).with(Abilities::NAMEPLATE, true),
        board: 0x1234_5678,
        vendor: 7,
        product: 8,
        revisions: 9,
        version: 0x0001_0002,
        counter: 5,
        facts: 0x0FAC_7500,
        reserved: 0,
    };
    let facts = Facts {
        board: 0x1234_5678,
        size: Facts::SIZE,
        autostart: 0x0201,
        crc_bits: 32,
        node_ids: 0x7F01,
        bit_rates: 0x1FF,
        abilities: header.features.0 as u16,
        sdo_request_base: 0x680,
        sdo_response_base: 0x480,
    };
    // Pointers of the chip have four bytes.
    let on_chip = |offset: usize| 8 + (offset - 8) * 4 / size_of::<usize>();
    let mut services = vec![0; on_chip(size_of::<Services>())];
    let size = services.len() as u32;
    for (at, word) in [
        (offset_of!(Services, version), ram_image::SERVICES_VERSION),
        (offset_of!(Services, size), size),
        (on_chip(offset_of!(Services, open)), 0x0800_0101),
        (on_chip(offset_of!(Services, get)), 0x0800_0103),
        (on_chip(offset_of!(Services, store)), 0x0800_0105),
        (on_chip(offset_of!(Services, next)), 0x0800_0107),
        (on_chip(offset_of!(Services, crc32)), 0x0800_0109),
        (on_chip(offset_of!(Services, is_blank)), 0x0800_010B),
        (on_chip(offset_of!(Services, sector_at)), 0x0800_010D),
        (on_chip(offset_of!(Services, facts)), 0x0800_0000 + size),
        (on_chip(offset_of!(Services, compact)), 0x0800_010F),
    ] {
        services[at..at + 4].copy_from_slice(&word.to_le_bytes());
    }
    services.extend(bytes(&facts));
    vec![
        written("RAM image header", bytes(&header), "Ok(())"),
        written("services and facts", services, some((2, facts))),
    ]
}

fn of_journals() -> Vec<Written> {
    let mut all = Vec::new();
    let mut add =
        |name: &str, bytes, seen: String| all.push(written(&format!("journal: {name}"), bytes, seen));
    let plain = ProgramRecord {
        size: 0x1_2340,
        crc: 0xCAFE_F00D,
        signed: true,
        confirmed: true,
        version: 77,
        half_erased: false,
        seal: None,
        withdrawn: false,
    };
    let sealed = ProgramRecord { signed: false, seal: Some(Seal::Locked), ..plain };
    for (name, number, record) in [
        ("released and confirmed", 1, plain),
        ("released", 1, ProgramRecord { confirmed: false, ..plain }),
        (
            "confirmed, sealed and withdrawn",
            254,
            ProgramRecord { half_erased: true, withdrawn: true, ..sealed },
        ),
        (
            "sealed and writing",
            2,
            ProgramRecord { confirmed: false, seal: Some(Seal::WritesFlash), ..sealed },
        ),
    ] {
        let [_, made] = journal(Key::program(number), record.value());
        add(&format!("program, {name}"), made, format!("{:?}", (Some(record), [0_u32; 2])));
    }
    let partial = [0x1122_3344, 0x0802_8000];
    let [id, end] = partial;
    let value = ProgramRecord::none(true, ProgramRecord::partial_of([0, id, end, 0]));
    let [_, made] = journal(Key::program(1), value);
    let none = None::<ProgramRecord>;
    add("no program, a download goes on", made, format!("{:?}", (none, partial)));
    for (name, state) in
        [("staged", State::Staged), ("confirmed", State::Confirmed), ("installed", State::Installed)]
    {
        let record = RenewalRecord { state, size: 0x9000, crc: 0xCAFE_F00D, home: 0x0BAD_CAFE };
        let [_, made] = journal(Key::program(renewal::BOOTLOADER), record.value());
        add(&format!("RAM image, {name}"), made, some(record));
    }
    for (name, id, bit_rate) in
        [("node-ID and bit rate", NodeId::new(127), BitRate::K125), ("no node-ID", None, BitRate::Auto)]
    {
        let node = NodeParameters { id, bit_rate };
        let [header, made] = journal(Key::NODE, node.value());
        add(name, made, format!("{node:?}"));
        if id.is_some() {
            add("header", header, format!("{node:?}"));
        }
    }

    all
}

fn key_block() -> Vec<u8> {
    let mut block = vec![0; seal::key_block::SIZE];
    for (at, data) in [
        (0, &seal::key_block::MAGIC[..]),
        (FLAGS, &FOR_TESTS.to_le_bytes()),
        (COUNTER, &[7]),
        (EPOCH, &[2]),
        (ROOTS, &[0x11]),
        (ROOTS + 4, &[0xA1; 32]),
        (ROOTS + KEY, &[0x12]),
        (ROOTS + KEY + 4, &[0xA2; 32]),
        (KEKS, &[0x21]),
        (KEKS + 4, &[0xB1; 32]),
        (KEKS + KEY, &[0x22]),
        (KEKS + KEY + 4, &[0xB2; 32]),
    ] {
        block[at..at + data.len()].copy_from_slice(data);
    }
    let check = boot_core::crc32(&block[..seal::key_block::CHECK]);
    block[seal::key_block::CHECK..].copy_from_slice(&check.to_le_bytes());
    block
}

#[test]
fn every_record_is_the_golden_one() {
    let written = [warm_starts(), of_boot_stage(), of_programs(), of_renewal(), of_journals()].concat();
    for Golden { name, bytes, .. } in golden() {
        let (_, made, seen) =
            written.iter().find(|(made, ..)| made == name).unwrap_or_else(|| panic!("nothing writes {name}"));
        assert!(
            made == bytes && read(name, bytes) == *seen,
            "{name} has changed: {FROZEN}.\n\
             golden  {bytes:02X?}\nwritten {made:02X?}\nread    {}\n        {seen}",
            read(name, bytes)
        );
    }
    assert_eq!(written.len(), golden().len(), "records.txt has not all of them");
}

/// The memory map of the design, typed again: the only second copy of these numbers.
#[test]
fn the_layout_of_the_stm32f407_is_the_documented_one() {
    let layout = &shared_abi::layout::stm32f407g_disc1::LAYOUT;
    assert_eq!(layout.bootloader, Region::new(0x0800_0000, 0x4000));
    assert_eq!(layout.home, Some(Region::new(0x0801_0000, 0x1_0000)));
    assert_eq!(layout.data, Some(Region::new(0x0800_C000, 0x4000)));
    assert_eq!(layout.staging, Some(Region::new(0x080E_0000, 0x2_0000)));
    assert_eq!(layout.callgate(), 0x0800_0040);
    assert_eq!(layout.parameters, [Region::new(0x0800_4000, 0x4000), Region::new(0x0800_8000, 0x4000)]);
    assert_eq!(layout.programs, [Region::new(0x0802_0000, 896 * 1024)]);
    assert_eq!(layout.ram, Region::new(0x2000_0000, 128 * 1024 - 64));
    assert_eq!(layout.handoff, Region::new(0x2001_FFC0, 48));
    assert_eq!(layout.warm_start, Region::new(0x2001_FFF0, 16));
}
