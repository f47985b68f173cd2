//! What the objects say, and what the device does beside a download: each object of each program,
//! emergencies, layer setting services, the second server, and commands in each other's way.

use std::task::Poll;

use boot_core::bootloader::{Bootloader, Choices, Config, Everything, Extras};
use boot_core::control::{Policy, Step};
use boot_core::decision::{self, choose, Exit, Images, Woken};
use boot_core::flash::FlashFault;
use boot_core::profile::Profile;
use boot_core::store::{Journal, Key, NodeParameters, Parameters, ProgramRecord};
use canopen::line::LineEvent;
use canopen::lss::{LssDevice, StoreError};
use canopen::od::{Address, Objects};
use canopen::program::ProgramStart;
use canopen::slave::SlaveDevice;
use canopen::{AbortCode, BitRate, NodeId};
use kit::bench::{new_flash, Bench, CLEAR, CLR_SIGNATURE, CONFIG, CONTROL, DATA, SET_SIGNATURE, START};
use kit::boot::{leaked, Boot};
use kit::model::{ModelFlash, CHIP};
use kit::rig::{
    block, blocks, crc32, hex, raw, words, Rig, ESACADEMY_1, LIFT_1, LIFT_2, PRODUCT_CODE, STANDARD_1,
    STANDARD_2, VENDOR_ID,
};
use shared_abi::boot_report::{BootReport, Reason};
use shared_abi::handoff::ResetCause;
use shared_abi::label;
use shared_abi::layout;
use shared_abi::warm_start::BootRequest;

/// 1F57h: the flash works, and nothing has failed.
pub(super) const BUSY: u32 = 1;

/// CiA 301, abort codes of SDO: not now, the device is in another state.
pub(super) const MAN_BUSY: AbortCode = AbortCode(0x0800_0022);
const NO_SUB_INDEX: AbortCode = AbortCode(0x0609_0011);

fn read(rig: &mut Rig, index: u16, sub: u8) -> Result<Vec<u8>, AbortCode> {
    let mut bytes = [0; 64];
    let len = rig.node.read(Address::new(index, sub), &mut bytes)?;
    Ok(bytes[..len].to_vec())
}

fn word(value: u32) -> Result<Vec<u8>, AbortCode> {
    Ok(value.to_le_bytes().to_vec())
}

// --- the profiles

/// Port's Paulus, table 3: 08000000h for an unknown request; CiA 301: 05040001h. ESAcademy: 1000h is
/// "BOOT", node-ID 64 at 125 kbit/s, 7F50h. CiA 417-1: profile 417 in the low half of 1000h; CiA 814-1:
/// node-ID 126.
#[test]
fn each_profile_is_that_of_its_document() {
    let of = |profile: Profile| {
        let default_node = profile.default_node.map(|(id, rate)| (id.get(), rate));
        (profile.device_type, profile.node_id.map(NodeId::get), default_node, profile.unknown_request.0)
    };
    assert_eq!(of(Profile::STANDARD), (0x1000_0000, None, None, 0x0504_0001));
    assert_eq!(of(Profile::PAULUS), (0x1000_0000, None, None, 0x0800_0000));
    let boot = u32::from_be_bytes(*b"BOOT");
    assert_eq!(of(Profile::ESACADEMY), (boot, None, Some((64, BitRate::K125)), 0x0504_0001));
    assert_eq!(of(Profile::LIFT), (0xFE00_0000 | 417, Some(126), None, 0x0504_0001));

    // Whether a password comes first, a reset starts the program, it starts by itself, it needs a label,
    // and 1F50h can be read.
    let rules = |profile: Profile| {
        let Policy { locked, reset_starts, starts_by_itself, wants_label, .. } = profile.download;
        (locked, reset_starts, starts_by_itself, wants_label, profile.extras.read_back)
    };
    assert_eq!(rules(Profile::STANDARD), (false, false, false, false, false));
    assert_eq!(rules(Profile::ESACADEMY), (true, true, true, false, false));
    assert_eq!(rules(Profile::LIFT), (true, true, false, true, true));

    // The number 494E4954h, the lowest byte first; the lift's is one of ours, as no document gives one.
    let passwords =
        [Profile::STANDARD, Profile::PAULUS, Profile::ESACADEMY, Profile::LIFT].map(|of| of.password);
    assert_eq!(passwords, [&b""[..], b"", b"TINI", b"coboot"]);
}

/// A stream leaves room of the queue for the client's segments while an answer is held back (ADR 9): 8 KiB,
/// or a quarter of a smaller queue.
#[test]
fn a_stream_leaves_a_reserve_of_the_queue() {
    for (queue, reserve) in [(65536, 8192), (16384, 4096), (4096, 1024)] {
        let mut rig = Rig::new(&STANDARD_1, queue);
        rig.begin(1, Some(3000), &raw(&STANDARD_1, 1, 3000)[..700]).unwrap();
        let [room, with_reserve] = [false, true].map(|held| rig.node.download_space(DATA, held));
        assert_eq!(with_reserve - room, reserve, "of {queue}");
    }
}

// --- the objects of a program

/// 2004h: address and size. 1F51h, 1F56h, 1F57h, 2005h: what is stored, of this program and no other.
#[test]
fn each_program_has_its_own_values_and_no_other_exists() {
    let mut rig = Rig::new(&STANDARD_2, 1024);
    let empty = |rig: &mut Rig, number| {
        assert_eq!((rig.state(number), rig.identification(number), rig.status(number)), (3, 0, 0));
        assert_eq!(rig.word(0x2005, number), 0);
    };
    empty(&mut rig, 1);
    empty(&mut rig, 2);
    let images = [raw(&STANDARD_2, 1, 700), raw(&STANDARD_2, 2, 900)];
    rig.install(2, &images[1]);
    empty(&mut rig, 1);
    rig.install(1, &images[0]);
    for _ in 0..2 {
        for (number, image) in (1..).zip(&images) {
            assert_eq!(rig.state(number), 0);
            assert_eq!(rig.identification(number), crc32(image));
            // The label of an image has its number as version.
            assert_eq!(rig.word(0x2005, number), u32::from(number));
            let region = STANDARD_2.region(number);
            let value = [region.base.to_le_bytes(), region.size.to_le_bytes()].concat();
            assert_eq!(read(&mut rig, 0x2004, number), Ok(value));
        }
        rig.reset();
    }
    rig.chip.model().touched.clear();
    for number in [0, 3, 254, 255] {
        for command in [START, CLEAR] {
            assert_eq!(rig.command(number, command), Err(NO_SUB_INDEX), "{number}");
        }
        assert_eq!(rig.begin(number, None, &[]), Err(NO_SUB_INDEX), "{number}");
        assert_eq!(rig.node.upload_start(Address::new(0x1F50, number)), Err(NO_SUB_INDEX), "{number}");
        assert_eq!((rig.state(number), rig.word(0x2005, number)), (3, 0), "{number}");
        assert_eq!(read(&mut rig, 0x2004, number), Ok(vec![0; 8]), "{number}");
    }
    assert_eq!(rig.chip.model().touched, []);
    // A product with one program has no second one.
    let mut rig = Rig::new(&STANDARD_1, 1024);
    assert_eq!(rig.command(2, START), Err(NO_SUB_INDEX));
    assert_eq!(rig.begin(2, None, &[]), Err(NO_SUB_INDEX));
}

/// The label must lie inside the program: bytes after it are none of its own.
#[test]
fn a_label_counts_from_the_first_size_that_holds_it() {
    let whole = (label::OFFSET as usize) + label::SIZE;
    for (size, version) in [(whole - 1, 0), (whole, 1), (whole + 1, 1)] {
        let mut rig = Rig::new(&STANDARD_1, 1024);
        let image = raw(&STANDARD_1, 1, whole + 4);
        rig.install(1, &image[..size]);
        assert_eq!(rig.word(0x2005, 1), version, "{size}");
        assert_eq!(rig.identification(1), crc32(&image[..size]));
    }
}

/// The version in a control block takes precedence over that of the label.
#[test]
fn a_control_block_names_the_version() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    let image = raw(&STANDARD_1, 1, 600);
    for (told, version) in [(0, 1), (77, 77)] {
        rig.clear(1);
        // Manual L-1112d_10, figure 13: size, vendor-ID, product code, version, date.
        let control = words(&[600, VENDOR_ID, PRODUCT_CODE, told, 0, 0]);
        let mut file = blocks(STANDARD_1.region(1).base, &image);
        file[0] = block(0, 0, &control);
        rig.send_all(1, file);
        assert_eq!((rig.state(1), rig.status(1)), (0, 0));
        assert_eq!(rig.word(0x2005, 1), version);
    }
}

/// Flash that is not written reads FFh, and belongs to the program: it is erased for it, too.
#[test]
fn a_hole_in_a_program_is_erased_with_it() {
    let region = STANDARD_1.region(1);
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.install(1, &raw(&STANDARD_1, 1, 0x2C00));
    let (first, last) = (raw(&STANDARD_1, 1, 256), [0x5A; 16]);
    // The record of the end is cut off from the first data, and the end from the second.
    let head = String::from_utf8(hex(region.base, &first)).unwrap();
    let tail = String::from_utf8(hex(region.base + 0x2800, &last)).unwrap();
    let text = head.lines().take(17).chain(tail.lines()).collect::<Vec<_>>().join("\n") + "\n";
    rig.clear(1);
    rig.send_all(1, [text.as_bytes()]);
    assert_eq!((rig.state(1), rig.status(1)), (0, 0));
    let mut whole = vec![0xFF; 0x2810];
    whole[..256].copy_from_slice(&first);
    whole[0x2800..].copy_from_slice(&last);
    assert_eq!(rig.cells(1)[..whole.len()], whole);
    assert_eq!(rig.identification(1), crc32(&whole));
}

// --- commands in each other's way

/// While a program is programmed or checked, the other one is not touched and does not start.
#[test]
fn a_command_for_the_other_program_waits_for_the_end_of_a_download() {
    let image = raw(&STANDARD_2, 1, 3000);
    let mut installed = Rig::new(&STANDARD_2, 1024);
    installed.install(2, &raw(&STANDARD_2, 2, 600));
    let before = installed.cells(2);
    for steps in 0..60 {
        for command in [START, CLEAR, SET_SIGNATURE, CLR_SIGNATURE] {
            let mut rig = Rig::on(&STANDARD_2, 4096, installed.chip.model().clone());
            rig.clear(1);
            rig.send(1, &image).unwrap();
            rig.steps(steps);
            let what = format!("{command:#x} after {steps} steps");
            assert_eq!(rig.command(2, command), Err(MAN_BUSY), "{what}");
            rig.settle();
            // The refusal stays visible, and nothing else came of it.
            assert_eq!(rig.status(2), 0x86, "{what}");
            assert_eq!(rig.node.take_boot_request(), None, "{what}");
            assert_eq!((rig.state(1), rig.status(1), rig.identification(1)), (0, 0, crc32(&image)), "{what}");
            assert_eq!((rig.state(2), rig.cells(2)), (0, before.clone()), "{what}");
        }
    }
}

/// A request to leave the bootloader ends everything else.
#[test]
fn whoever_leaves_takes_no_further_order() {
    let mut rig = Rig::new(&STANDARD_2, 1024);
    rig.install(1, &raw(&STANDARD_2, 1, 600));
    rig.install(2, &raw(&STANDARD_2, 2, 600));
    rig.work(1, SET_SIGNATURE);
    rig.command(1, START).unwrap();
    for number in [1, 2] {
        for command in [START, CLEAR, SET_SIGNATURE, CLR_SIGNATURE] {
            assert_eq!(rig.command(number, command), Err(MAN_BUSY));
        }
        assert_eq!(rig.begin(number, None, &[]), Err(MAN_BUSY));
    }
    assert_eq!(rig.node.store(NodeId::new(9), None), Poll::Ready(Err(StoreError::Failed)));
    assert_eq!(rig.node.take_boot_request(), Some(BootRequest::Start(1)));
    assert_eq!(rig.node.take_boot_request(), None);
    rig.settle();
    assert_eq!((rig.state(1), rig.state(2)), (0, 0));
}

/// A reset would undo what is acknowledged: the device says so until it is done.
#[test]
fn an_acknowledged_order_is_finishing_until_it_is_stored() {
    let mut rig = Rig::new(&STANDARD_1, 4096);
    let image = raw(&STANDARD_1, 1, 900);
    assert!(!rig.node.is_finishing());
    rig.clear(1);
    rig.begin(1, None, &image).unwrap();
    rig.settle();
    assert!(!rig.node.is_finishing(), "half a program is none");
    rig.node.download_end(DATA).unwrap();
    let (mut steps, mut readable) = (0, 0);
    while rig.node.is_finishing() {
        readable += u32::from(rig.stored().records[0].is_some());
        assert!(!rig.node.is_idle_after_step());
        steps += 1;
    }
    assert!(steps > 10 && rig.stored().records[0].is_some());
    // The mark, a word, follows the record.
    assert!(readable <= 5, "{readable} steps");
    rig.settle();
    rig.command(1, SET_SIGNATURE).unwrap();
    assert!(rig.node.is_finishing());
    rig.settle();
    assert!(!rig.node.is_finishing());
    assert!(rig.stored().records[0].unwrap().2);
}

/// What changes nothing writes nothing, at once and after any number of starts: 83h of a released
/// program, 84h of one that is not, CLEAR of no program, LSS with the stored values, a password again.
#[test]
fn what_changes_nothing_writes_nothing() {
    for setup in [&STANDARD_1, &LIFT_1] {
        let node = NodeParameters { id: NodeId::new(9), bit_rate: BitRate::K250 };
        let store = |rig: &mut Rig| {
            assert_eq!(rig.node.store(node.id, Some(node.bit_rate)), Poll::Pending);
            rig.settle();
            assert_eq!(rig.node.stored(), Poll::Ready(Ok(())));
        };
        let mut rig = Rig::new(setup, 4096);
        store(&mut rig);
        rig.install(1, &raw(setup, 1, 600));
        for (command, released) in [(SET_SIGNATURE, true), (CLR_SIGNATURE, false)] {
            rig.unlock(1).unwrap();
            rig.work(1, command);
            rig.reset();
            rig.chip.model().touched.clear();
            for round in 0..30 {
                rig.unlock(1).unwrap();
                assert_eq!(rig.command(1, command), Ok(()));
                rig.settle();
                store(&mut rig);
                assert_eq!(rig.status(1), 0);
                if round % 3 == 0 {
                    rig.reset();
                }
                let what = format!("{}, {command:02X}h, round {round}", setup.name);
                assert_eq!(rig.chip.model().touched, [], "{what}");
            }
            assert_eq!(rig.stored().records[0].map(|record| record.2), Some(released));
            assert_eq!(rig.stored().node, node);
        }
    }
}

/// The password of ESAcademy makes the program invalid, once.
#[test]
fn a_password_that_finds_no_program_writes_nothing() {
    let mut rig = Rig::new(&ESACADEMY_1, 4096);
    rig.install(1, &raw(&ESACADEMY_1, 1, 600));
    rig.open(1);
    assert_eq!(rig.stored().records[0], None);
    rig.chip.model().touched.clear();
    for round in 0..30 {
        if round % 3 == 0 {
            rig.reset();
        }
        rig.open(1);
        assert_eq!(rig.chip.model().touched, [], "round {round}");
    }
}

// --- layer setting services

#[test]
fn node_id_and_bit_rate_are_stored_one_after_the_other_and_kept() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    let board = rig.stored().node;
    assert_eq!(rig.node.stored(), Poll::Ready(Ok(())), "nothing was asked for");
    assert_eq!(rig.node.store(NodeId::new(9), Some(BitRate::K500)), Poll::Pending);
    assert_eq!((rig.node.stored(), rig.stored().node), (Poll::Pending, board));
    assert_eq!(rig.node.store(NodeId::new(10), None), Poll::Ready(Err(StoreError::Failed)), "one at a time");
    rig.settle();
    assert_eq!(rig.node.stored(), Poll::Ready(Ok(())));
    assert_eq!(rig.stored().node, NodeParameters { id: NodeId::new(9), bit_rate: BitRate::K500 });
    // Without a bit rate the one before is kept; without a node-ID the device has none.
    assert_eq!(rig.node.store(None, None), Poll::Pending);
    rig.settle();
    assert_eq!(rig.stored().node, NodeParameters { id: None, bit_rate: BitRate::K500 });
    rig.reset();
    assert_eq!(rig.node.store(NodeId::new(11), None), Poll::Pending);
    rig.settle();
    assert_eq!(rig.stored().node, NodeParameters { id: NodeId::new(11), bit_rate: BitRate::K500 });
}

/// The flash does one thing at a time. What is refused is reported, and changes nothing.
#[test]
fn a_store_while_the_flash_works_is_refused() {
    let image = raw(&STANDARD_1, 1, 900);
    for steps in 0..40 {
        let mut rig = Rig::new(&STANDARD_1, 4096);
        rig.clear(1);
        let board = rig.stored().node;
        rig.send(1, &image).unwrap();
        rig.steps(steps);
        assert_eq!(rig.node.store(NodeId::new(9), None), Poll::Ready(Err(StoreError::Failed)), "{steps}");
        rig.settle();
        assert_eq!((rig.state(1), rig.stored().node), (0, board), "{steps}");
    }
}

#[test]
fn a_store_that_the_flash_refuses_is_told_and_the_old_values_stay() {
    let mut rig = Rig::new(&STANDARD_1, 1024);
    let board = rig.stored().node;
    let next = rig.chip.model().operations + 1;
    rig.chip.model().fail = Some((next, FlashFault::Protected));
    assert_eq!(rig.node.store(NodeId::new(9), None), Poll::Pending);
    rig.settle();
    assert_eq!(rig.node.stored(), Poll::Ready(Err(StoreError::Failed)));
    assert_eq!(rig.stored().node, board);
    // The next one is not held up by it.
    assert_eq!(rig.node.store(NodeId::new(9), None), Poll::Pending);
    rig.settle();
    assert_eq!(rig.node.stored(), Poll::Ready(Ok(())));
}

/// A product that stores nothing by layer setting services, and takes some node-IDs alone.
struct Fixed;

impl Choices for Fixed {
    const LSS_STORE: bool = false;
    const DECISION: &'static decision::Policy =
        &decision::Policy { node_ids: 2..=100, ..decision::Policy::plain(layout::DEFAULT, &[1]) };
    const PROGRAM_START: ProgramStart = ProgramStart { watchdog_ms: 0x0403, by_itself: [2, 1] };
}

#[test]
fn a_device_that_stores_nothing_says_so() {
    let mut flash = ModelFlash::new(&CHIP);
    let mut fixed = with_choices::<Fixed>(&mut flash);
    assert_eq!(fixed.store(NodeId::new(9), None), Poll::Ready(Err(StoreError::Unsupported)));
    assert!(fixed.supports(BitRate::K125) && !fixed.supports(BitRate::K800));
    let taken = |id| fixed.takes(NodeId::new(id).unwrap());
    assert_eq!([1, 2, 100, 101, 127].map(taken), [false, true, true, false, false]);
    let mut word = [0; 4];
    assert_eq!(fixed.read(Address::new(0x2007, 10), &mut word), Ok(4));
    assert_eq!(word, [3, 4, 2, 1], "watchdog, then the programs that start by themselves");
    assert!(flash.touched.is_empty());
}

/// A master that writes an object of an update is at work, whatever comes of it: the device waits for it. For
/// another object it does not.
#[test]
fn who_writes_an_object_of_an_update_holds_the_device() {
    let cases: [(u16, u8, &[u8], bool); 8] = [
        (0x1F51, 1, &[CLEAR], true),
        (0x1F51, 1, &[0x55], true),
        (0x6005, 1, b"wrong", true),
        (0x7F50, 1, &[0; 4], true),
        (0x2002, 2, &[0; 4], true),
        (0x2008, 0, b"none", true),
        (0x1201, 1, &[0; 4], false),
        (0x1003, 0, &[0], false),
    ];
    for (index, sub, data, holds) in cases {
        let mut node = with_choices::<Everything>(new_flash());
        assert!(!node.is_asked());
        let _ = node.write(Address::new(index, sub), data);
        assert_eq!(node.is_asked(), holds, "{index:04X}h");
    }
    let mut node = with_choices::<Everything>(new_flash());
    let _ = node.download_start(DATA, None);
    assert!(node.is_asked());
}

/// A bootloader with this report of the boot stage.
fn reported(flash: &mut ModelFlash, config: Config, node: NodeParameters, report: BootReport) -> Bench<'_> {
    let (buffer, sealed) = leaked(256);
    let config = Box::leak(Box::new(config));
    Bench { node: Boot { config, serial_number: 0x1234_5678, node, report }.on(flash, buffer, sealed) }
}

/// A bootloader of a product with these choices.
fn with_choices<C: Choices>(flash: &mut ModelFlash) -> Bootloader<'static, &mut ModelFlash, Journal, 1, C> {
    let parameters = Journal::open(flash, CONFIG.layout.parameters);
    let (buffer, sealed) = leaked(256);
    Boot::new(&CONFIG, kit::bench::node()).with(parameters, flash, buffer, sealed)
}

// --- emergencies, identity, the second server

/// CiA 301 table 26: 5000h hardware, 6300h data set; then the code of 1F57h, and the program.
#[test]
fn the_end_of_work_is_told_by_an_emergency() {
    let emergency = |rig: &mut Rig| rig.node.next_emergency();
    // Operation 12 is one of the store, 20 one of the data.
    for (fault, operation, code) in
        [(FlashFault::Failed, 12, 0x10), (FlashFault::Failed, 20, 0x0A), (FlashFault::Protected, 20, 0x0E)]
    {
        let mut rig = Rig::new(&STANDARD_2, 1024);
        let image = raw(&STANDARD_2, 2, 600);
        rig.clear(2);
        rig.begin(2, None, &image).unwrap();
        assert_eq!(emergency(&mut rig), None);
        let before = rig.chip.model().operations;
        rig.chip.model().fail = Some((before + operation, fault));
        rig.settle();
        // Bits 0 and 7 of the error register: generic, manufacturer specific.
        assert_eq!(emergency(&mut rig), Some([0x00, 0x50, 0x81, code, 2, 0, 0, 0]));
        assert_eq!((emergency(&mut rig), read(&mut rig, 0x1001, 0)), (None, Ok(vec![0x81])));
        rig.cancel(2);
        rig.install(2, &image);
        assert_eq!(emergency(&mut rig), Some([0; 8]), "error reset");
        assert_eq!((emergency(&mut rig), read(&mut rig, 0x1001, 0)), (None, Ok(vec![0])));
    }
    // A block with a wrong CRC.
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.clear(1);
    let mut bad = block(0, 0, &[0; 8]);
    *bad.last_mut().unwrap() ^= 1;
    assert!(rig.send(1, &bad).is_err());
    rig.settle();
    assert_eq!(emergency(&mut rig), Some([0x00, 0x63, 0x81, 0x06, 1, 0, 0, 0]));
    assert_eq!(read(&mut rig, 0x1003, 1), word(0x0106_6300));
}

/// Why the device stayed: a fault and a crash loop are errors; with `boot_up_emergency`, each
/// boot-up message is followed by the reason.
#[test]
fn a_device_tells_why_it_stayed() {
    let messages = |reason: u8, boot_up_emergency| {
        let config = Config { boot_up_emergency, ..CONFIG };
        let report = BootReport { reason, ..BootReport::NONE };
        let mut bench = reported(new_flash(), config, kit::bench::node(), report);
        // Vendor-ID, product code and revision are those of the configuration.
        let identity = [1, 2, 3, 4].map(|sub| bench.word(Address::new(0x1018, sub)));
        assert_eq!(identity, [0, 0, 0, 0x1234_5678]);
        let node = &mut bench.node;
        assert_eq!(node.node_id(), NodeId::new(5));
        assert_eq!(node.lss_address().serial_number, 0x1234_5678);
        node.node_id_changed(None);
        let before = [node.next_emergency(), node.next_emergency()];
        node.node_id_changed(NodeId::new(5));
        [before[0], before[1], node.next_emergency(), node.next_emergency()]
    };
    let boot = |reason| Some([0x00, 0xFF, 0, b'B', b'O', b'O', b'T', reason]);
    assert_eq!(messages(0, false), [None; 4]);
    assert_eq!(messages(0, true), [None, None, boot(0), None]);
    assert_eq!(messages(8, true), [None, None, boot(8), None]);
    for reason in [2, 7] {
        let error = Some([0x00, 0x60, 0x01, reason, 0, 0, 0, 0]);
        assert_eq!(messages(reason, false), [error, None, None, None]);
    }
}

/// What the boot stage would choose after a power-on now: 255 for a program.
fn next_choice(rig: &Rig) -> u8 {
    let (flash, layout) = (rig.chip.model().clone(), rig.setup.layout);
    let journal = Journal::open(&flash, layout.parameters);
    let woken = Woken::power_on(rig.stored().node.id_or_none(), BitRate::K125);
    let policy = decision::Policy::plain(layout, &[1, 2]);
    match choose(&woken, &Images::SOUND, &flash, &journal, &policy).exit {
        Exit::Bootloader { stay, .. } => stay.reason as u8,
        _ => 255,
    }
}

/// 2007h/2 is what is so now, and what the boot stage goes by; 2007h/11 is what was so at the last reset, and 2007h/12
/// which programs are released.
#[test]
fn the_reason_to_stay_is_that_of_the_next_reset() {
    let mut rig = Rig::new(&STANDARD_2, 4096);
    let is = |rig: &mut Rig, what: &str, reason: u32, released: u32| {
        rig.settle();
        assert_eq!(u32::from(next_choice(rig)), reason, "{what}: the boot stage");
        assert_eq!([2, 11, 12].map(|sub| rig.word(0x2007, sub)), [reason, 0, released], "{what}");
    };
    is(&mut rig, "a new device", 6, 0);
    rig.install(1, &raw(&STANDARD_2, 1, 700));
    is(&mut rig, "a raw image is released", 255, 1);
    for (command, reason, released) in [(CLR_SIGNATURE, 5, 0), (SET_SIGNATURE, 255, 1), (CLR_SIGNATURE, 5, 0)]
    {
        rig.command(1, command).unwrap();
        is(&mut rig, "a command", reason, released);
    }
    rig.install(2, &raw(&STANDARD_2, 2, 700));
    is(&mut rig, "program 2 starts in its place", 255, 2);
    for (program, reason) in [(2, 5), (1, 6)] {
        for _ in 0..2 {
            rig.work(program, CLEAR);
        }
        is(&mut rig, "erased", reason, 0);
    }
}

/// 2007h: what the boot stage reported, and what is so now.
#[test]
fn the_state_of_the_device_is_what_the_boot_stage_reported() {
    for (last, crash_resets, id, now) in [
        (1, 0, 5, 1),
        (2, 3, 5, 2),
        (0, 2, 5, 255),
        (9, 0, 5, 9),
        (10, 0, 5, 10),
        (4, 0, 255, 4),
        (11, 0, 5, 255),
    ] {
        let mut rig = Rig::new(&STANDARD_1, 4096);
        rig.install(1, &raw(&STANDARD_1, 1, 700));
        rig.work(1, SET_SIGNATURE);
        let mut flash = rig.chip.model().clone();
        // A program that the boot stage has found damaged is none, whatever kept the device before.
        let refused = u8::from([9, 10].contains(&now));
        let reason = if refused > 0 { now } else { last };
        let report = BootReport { reason, crash_resets, refused, ..BootReport::NONE };
        let node = NodeParameters { id: NodeId::new(id), ..kit::bench::node() };
        let mut bench = reported(&mut flash, CONFIG, node, report);
        bench.node.node_id_changed(NodeId::new(5));
        assert_eq!(bench.word(Address::new(0x2007, 2)), u32::from(now), "after {last}");
    }
    let report = BootReport {
        reason: Reason::Unsigned as u8,
        program_reset: ResetCause::IndependentWatchdog as u8,
        crash_resets: 3,
        ..BootReport::NONE
    };
    let mut bench = reported(new_flash(), CONFIG, kit::bench::node(), report);
    for (sub, value) in [(1, 0), (2, 2), (11, 5), (3, 4), (4, 3)] {
        let mut byte = [0xEE];
        assert_eq!(bench.node.read(Address::new(0x2007, sub), &mut byte), Ok(1));
        assert_eq!(byte, [value], "2007h/{sub}");
    }
    assert_eq!(bench.word(Address::new(0x2007, 10)), 0);
}

/// A START that came to nothing after the reset: 1F57h is 02h for that program. A damaged program is
/// none any more; a sound one that may not start at present stays.
#[test]
fn a_start_that_the_boot_stage_refused_is_no_valid_program() {
    for (reason, stays) in [
        (Reason::Damaged, false),
        (Reason::Vectors, false),
        (Reason::NodeId, true),
        (Reason::Forbidden, true),
        (Reason::Unsigned, true),
    ] {
        for refused in [0, 1, 2, 255] {
            let mut rig = Rig::new(&STANDARD_1, 4096);
            rig.install(1, &raw(&STANDARD_1, 1, 700));
            let mut flash = rig.chip.model().clone();
            let report = BootReport { reason: reason as u8, refused, ..BootReport::NONE };
            let mut bench = reported(&mut flash, CONFIG, kit::bench::node(), report);
            let mut read = |index| bench.word(Address::new(index, 1));
            let is_named = refused == 1;
            assert_eq!(read(0x1F57), if is_named { 0x02 } else { 0 }, "{reason:?}, program {refused}");
            let is_there = stays || !is_named;
            assert_eq!(read(0x1F56) != 0, is_there, "{reason:?}, program {refused}");
            assert_eq!(read(0x1F51), if is_there { 0 } else { 3 }, "{reason:?}, program {refused}");
        }
    }
}

/// 1201h: written by a master, back to nothing with the next reset of the communication (CiA 301
/// clause 7.3.2.2.1).
#[test]
fn the_second_server_has_the_channel_that_it_is_told_until_the_communication_is_reset() {
    let mut bench = Bench::with_config(new_flash(), CONFIG, 256);
    let fresh = bench.node.second_server();
    let at = |sub| Address::new(0x1201, sub);
    bench.node.write(at(1), &0x0000_06A0_u32.to_le_bytes()).unwrap();
    bench.node.write(at(2), &0x0000_01A0_u32.to_le_bytes()).unwrap();
    assert_eq!((bench.word(at(1)), bench.word(at(2))), (0x6A0, 0x1A0));
    assert_ne!(bench.node.second_server(), fresh);
    bench.node.node_id_changed(NodeId::new(5));
    assert_eq!(bench.node.second_server(), fresh);
    assert_ne!(bench.word(at(1)) & 0x8000_0000, 0, "the channel does not exist");
}

/// A product that does without them has no second server, no progress and no date of a program; it takes no
/// Intel HEX, and a request for a block transfer is unknown.
#[test]
fn what_a_product_does_without_is_not_there() {
    use canopen::sdo::server::{Config as ServerConfig, SdoServer};
    struct Least;
    impl Choices for Least {
        const EXTRAS: Extras =
            Extras { second_server: false, resume: false, program_date: false, ..Extras::STANDARD };
        const INTEL_HEX: bool = false;
        const BLOCK_DOWNLOAD: bool = false;
        const BLOCK_UPLOAD: bool = false;
    }
    let mut least = with_choices::<Least>(new_flash());
    let channel = least.second_server();
    assert!(least.write(Address::new(0x1201, 1), &0x0000_06A0_u32.to_le_bytes()).is_err());
    assert_eq!(least.second_server(), channel);
    // The dictionary of this configuration has these objects, and nothing stands behind them.
    for (index, sub) in [(0x1201, 1), (0x2006, 1), (0x1F52, 1), (0x1F52, 2)] {
        assert!(least.read(Address::new(index, sub), &mut [0; 8]).is_err(), "{index:04X}h/{sub}");
    }
    assert_eq!(least.download_start(DATA, None), Ok(()));
    assert!(least.download_data(DATA, b":10000000").is_err(), "Intel HEX");
    // Nor does it take a password, or give a program back.
    for index in [0x7F50, 0x6005, 0x2002] {
        assert!(least.write(Address::new(index, 1), &[0; 4]).is_err(), "{index:04X}h");
    }
    assert_eq!(least.write(Address::new(0x2008, 0), b"roml"), Err(AbortCode(0x0601_0000)));
    assert!(least.upload_start(DATA).is_err());
    assert!(least.upload_data(DATA, 0, &mut [0; 7]).is_err());

    let unknown_request = AbortCode(0x0800_0000);
    let node = NodeId::new(5).unwrap();
    let mut server = SdoServer::new(node, ServerConfig { unknown_request, ..ServerConfig::DEFAULT });
    let now = canopen::Instant::from_millis(0);
    let mut ask = |request| {
        server.handle(&canopen::Frame::full(canopen::CobId::sdo_request(node), request), now, &mut least);
        *server.poll(now, &mut least).unwrap().exactly::<8>().unwrap()
    };
    // An abort has the multiplexor of its request (CiA 301 clause 7.2.4.3.17): clause 7.2.4.3.13, initiate of
    // 1018h/1, and clause 7.2.4.3.9, of 1F50h/1. The start, acknowledgement and end of a block transfer and
    // an unknown command have none: then that of the open transfer, or none.
    let [none, name] = [[0; 3], [0x08, 0x10, 0]];
    for (before, at_before) in
        [([0x40, 0x18, 0x10, 2, 0, 0, 0, 0], none), ([0x40, 0x08, 0x10, 0, 0, 0, 0, 0], name)]
    {
        for (request, [low, high, sub]) in [
            ([0xA4, 0x18, 0x10, 1, 127, 0, 0, 0], [0x18, 0x10, 1]),
            ([0xC6, 0x50, 0x1F, 1, 100, 0, 0, 0], [0x50, 0x1F, 1]),
            ([0xA3, 0, 0, 0, 0, 0, 0, 0], at_before),
            ([0xA2, 1, 127, 0, 0, 0, 0, 0], at_before),
            ([0xA1, 0, 0, 0, 0, 0, 0, 0], at_before),
            ([0xC1, 1, 2, 0, 0, 0, 0, 0], at_before),
            ([0xE0, 0x57, 0x1F, 1, 0, 0, 0, 0], at_before),
        ] {
            assert_ne!(ask(before)[0], 0x80);
            assert_eq!(
                ask(request),
                [0x80, low, high, sub, 0, 0, 0, 8],
                "{request:02X?} after {before:02X?}"
            );
        }
    }
}

// --- the lift profile: a stored program can be read

#[test]
fn a_stored_program_can_be_read_by_who_has_the_password() {
    let mut rig = Rig::new(&LIFT_1, 1024);
    assert_eq!(rig.node.upload_start(DATA), Err(MAN_BUSY), "locked");
    rig.open(1);
    assert_eq!(rig.node.upload_start(DATA), Err(AbortCode(0x0800_0024)), "no data");
    let mut image = raw(&LIFT_1, 1, 1500);
    image[600..630].copy_from_slice(b"$CANopenSoftwareVersion\x004.7.1\0");
    rig.install(1, &image);
    assert_eq!(read(&mut rig, 0x100A, 0), Ok(b"4.7.1".to_vec()), "CiA 814-1 clause 6.5");
    assert_eq!(rig.node.upload_start(DATA), Ok(Some(1500)));
    for (offset, len, expected) in [
        (0, 7, &image[..7]),
        (7, 889, &image[7..896]),
        (1490, 64, &image[1490..]),
        (1500, 7, &[]),
        (9000, 7, &[]),
    ] {
        let mut bytes = vec![0; len];
        assert_eq!(rig.node.upload_data(DATA, offset, &mut bytes), Ok(expected.len()), "{offset}");
        assert_eq!(bytes[..expected.len()], *expected, "{offset}");
    }
    // Not while the flash works.
    rig.begin(1, None, &image).unwrap();
    rig.steps(1);
    assert_eq!(rig.node.upload_start(DATA), Err(MAN_BUSY));
    // The standard profile has no such thing.
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.install(1, &raw(&STANDARD_1, 1, 300));
    assert_eq!(rig.node.upload_start(DATA), Err(AbortCode(0x0601_0001)), "write only");
}

/// Program 2 of a lift is a set of parameters: any bytes, and 1F51h does not start it.
#[test]
fn data_of_the_application_are_any_bytes() {
    let mut rig = Rig::new(&LIFT_2, 1024);
    for data in [&b"x"[..], b"0123456789", &[0xFF; 100]] {
        rig.install(2, data);
        assert_eq!((rig.state(2), rig.identification(2)), (0, crc32(data)));
        rig.work(2, START);
        assert_eq!((rig.status(2), rig.node.take_boot_request()), (0x02, None), "NOVALPROG");
        // Nor does a START that comes before they are verified.
        rig.unlock(2).unwrap();
        rig.send(2, data).unwrap();
        assert_eq!(rig.command(2, START), Err(MAN_BUSY));
        rig.settle();
        assert_eq!((rig.state(2), rig.node.take_boot_request()), (0, None));
    }
}

/// The steps of a device that has nothing to do.
#[test]
fn an_idle_device_stays_idle() {
    let mut bench = Bench::with(new_flash(), Policy { read_back: true, ..Policy::DEFAULT });
    assert_eq!(bench.node.step(), Step::Idle);
    assert!(!bench.node.busy() && !bench.node.is_finishing());
    bench.node.write(CONTROL, &[CLEAR]).unwrap();
    bench.settle();
    assert!(!bench.node.busy());
    bench.node.write(CONTROL, &[CLEAR]).unwrap();
    assert!(bench.node.busy());
    assert_eq!(bench.status() & BUSY, BUSY);
    bench.settle();
    let journal = Journal::open(bench.node.flash(), kit::bench::LAYOUT.parameters);
    assert!(journal.get(bench.node.flash(), Key::program(1)).is_some());
}

// --- confirmation, the queue's room, and where a block may lie

/// The stored record of program 1.
fn record(bench: &mut Bench<'_>) -> Option<ProgramRecord> {
    let flash = bench.node.flash();
    Journal::open(flash, kit::bench::LAYOUT.parameters).program(flash, 1)
}

/// Only the confirmation marks a program that has returned the device; it is stored once.
#[test]
fn a_program_that_came_back_is_confirmed_once() {
    let mut bench = Bench::new(new_flash());
    let confirmed = |bench: &mut Bench<'_>| record(bench).map(|record| record.confirmed);
    bench.node.confirm(1);
    bench.settle();
    assert_eq!(confirmed(&mut bench), None, "there is no program");
    bench.install(&kit::bench::program(200, 0x11));
    for nobody in [0, 2, 255] {
        bench.node.confirm(nobody);
        bench.settle();
    }
    assert_eq!(confirmed(&mut bench), Some(false));
    // A store that fails costs a rescue window, and no emergency.
    let next = bench.node.flash().operations + 1;
    bench.node.flash().fail = Some((next, FlashFault::Protected));
    bench.node.confirm(1);
    bench.settle();
    assert_eq!((confirmed(&mut bench), bench.node.next_emergency(), bench.status()), (Some(false), None, 0));
    bench.node.confirm(1);
    bench.settle();
    assert_eq!(confirmed(&mut bench), Some(true));
    bench.node.flash().touched.clear();
    bench.node.confirm(1);
    bench.settle();
    assert_eq!(bench.node.flash().touched, []);
}

/// A confirmation does not come between the operations of other work.
#[test]
fn a_busy_device_confirms_nothing() {
    let mut flash = ModelFlash::new(&CHIP);
    let mut bench = Bench::new(&mut flash);
    bench.install(&kit::bench::program(200, 0x11));
    assert_eq!(bench.node.store(NodeId::new(9), None), Poll::Pending);
    bench.node.confirm(1);
    bench.settle();
    assert_eq!(bench.node.stored(), Poll::Ready(Ok(())));
    assert!(!record(&mut bench).unwrap().confirmed);
    let flash = bench.node.flash();
    let journal = Journal::open(flash, kit::bench::LAYOUT.parameters);
    assert_eq!(journal.get(flash, Key::NODE).map(|[id, ..]| id), Some(9));
}

/// Both change the record: the second would be written from what the first has replaced. To start
/// the program changes nothing.
#[test]
fn a_signature_waits_for_a_confirmation() {
    let mut bench = Bench::new(new_flash());
    bench.install(&kit::bench::program(200, 0x11));
    for command in [SET_SIGNATURE, CLR_SIGNATURE] {
        bench.node.confirm(1);
        assert_eq!(bench.node.write(CONTROL, &[command]), Err(MAN_BUSY));
    }
    assert_eq!(bench.node.write(CONTROL, &[START]), Ok(()));
    bench.settle();
    assert_eq!(bench.node.take_boot_request(), Some(BootRequest::Trial(1)));
    assert_eq!(bench.command(SET_SIGNATURE), 0);
    let record = record(&mut bench).unwrap();
    assert!(record.confirmed && record.signed);
}

/// CiA 301 table 26: 8120h, error passive.
#[test]
fn an_event_of_the_line_is_told() {
    let mut bench = Bench::new(new_flash());
    bench.node.line_event(LineEvent::Passive);
    assert_eq!(bench.node.next_emergency(), Some([0x20, 0x81, 0x11, 0, 0, 0, 0, 0]));
}

/// 1F57h is busy from the end of the transfer until the record is stored: a host that starts the
/// program earlier would start the old one.
#[test]
fn the_status_is_busy_until_the_program_is_one() {
    let mut rig = Rig::new(&STANDARD_2, 4096);
    rig.clear(1);
    rig.send(1, &raw(&STANDARD_2, 1, 900)).unwrap();
    while rig.stored().records[0].is_none() {
        assert_eq!(rig.status(1) & BUSY, BUSY);
        assert!(rig.node.is_finishing());
        rig.steps(1);
    }
    rig.settle();
    assert_eq!((rig.status(1), rig.status(2)), (0, 0));
    rig.command(1, SET_SIGNATURE).unwrap();
    while !rig.stored().records[0].unwrap().2 {
        assert_eq!((rig.status(1) & BUSY, rig.status(2) & BUSY), (BUSY, 0));
        rig.steps(1);
    }
}

/// A queue that has no room for another block takes none; one that has takes the next block while
/// the flash works, of this program and of no other.
#[test]
fn the_next_block_is_taken_while_the_flash_works_if_there_is_room() {
    let region = STANDARD_2.region(1);
    let image = raw(&STANDARD_2, 1, 600);
    for (buffer, room) in [(1024, false), (64 * 1024, true)] {
        let mut rig = Rig::new(&STANDARD_2, buffer);
        rig.clear(1);
        rig.send(1, &block(0, 0, &words(&[600, VENDOR_ID, PRODUCT_CODE]))).unwrap();
        rig.send(1, &block(1, region.base, &image)).unwrap();
        assert_eq!(rig.status(1) & BUSY, u32::from(!room));
        let next = rig.node.download_start(DATA, None);
        assert_eq!(next, if room { Ok(()) } else { Err(MAN_BUSY) }, "{buffer}");
        rig.cancel(1);
        assert_eq!(rig.node.download_start(Address::new(0x1F50, 2), None), Err(MAN_BUSY), "{buffer}");
    }
}

/// The end of a program may be flash that no block has: it must be erased all the same.
#[test]
fn what_no_block_has_belongs_to_the_program_and_is_erased() {
    let region = STANDARD_1.region(1);
    let mut rig = Rig::new(&STANDARD_1, 1024);
    rig.install(1, &raw(&STANDARD_1, 1, 0x2800));
    let data = raw(&STANDARD_1, 1, 600);
    let mut whole = vec![0xFF; 0x2400];
    whole[..600].copy_from_slice(&data);
    rig.clear(1);
    let mut file = blocks(region.base, &data);
    file[2] = block(u32::MAX, 0, &words(&[0x2400, crc32(&whole)]));
    rig.send_all(1, file);
    assert_eq!((rig.state(1), rig.status(1), rig.identification(1)), (0, 0, crc32(&whole)));
    assert_eq!(rig.cells(1)[..whole.len()], whole);
}

/// A password is no way around other work.
#[test]
fn a_password_waits_for_what_is_acknowledged() {
    let image = raw(&ESACADEMY_1, 1, 900);
    let mut rig = Rig::new(&ESACADEMY_1, 4096);
    rig.open(1);
    rig.send(1, &image).unwrap();
    while rig.stored().records[0].is_none() {
        assert_eq!(rig.unlock(1), Err(MAN_BUSY));
        rig.steps(1);
    }
    rig.settle();
    // The program is about to start.
    assert_eq!(rig.unlock(1), Err(MAN_BUSY));
    assert!(rig.node.take_boot_request().is_some());
    rig.unlock(1).unwrap();
}

/// A password begins anew: a program that was streamed before it is not fresh, and no failure is left.
#[test]
fn a_password_leaves_nothing_of_the_session_before() {
    let mut rig = Rig::new(&LIFT_1, 4096);
    rig.install(1, &raw(&LIFT_1, 1, 600));
    rig.unlock(1).unwrap();
    rig.command(1, START).unwrap();
    let request = rig.node.take_boot_request();
    assert!(matches!(request, Some(BootRequest::Start(1) | BootRequest::Trial(1))), "{request:?}");
    assert!(rig.send(1, &block(7, LIFT_1.region(1).base, &[0; 8])).is_err());
    assert_ne!(rig.status(1), 0);
    rig.unlock(1).unwrap();
    assert_eq!(rig.status(1), 0);
}

/// A lift takes another program without CLEAR, the others do not.
#[test]
fn a_program_is_replaced_without_clear_where_the_profile_says_so() {
    for (setup, replaces) in [(&LIFT_1, true), (&STANDARD_1, false)] {
        let mut rig = Rig::new(setup, 4096);
        rig.install(1, &raw(setup, 1, 600));
        rig.reset();
        rig.open(1);
        rig.send(1, &raw(setup, 1, 700)).map_or_else(|_| assert!(!replaces), |()| assert!(replaces));
        rig.settle();
        let size = if replaces { 700 } else { 600 };
        assert_eq!(rig.stored().records[0].map(|record| record.0), Some(size));
        // Once more in the same session, also after a download that broke off.
        if replaces {
            rig.begin(1, None, &raw(setup, 1, 800)[..700]).unwrap();
            rig.settle();
            rig.cancel(1);
            rig.send_all(1, [&raw(setup, 1, 800)]);
            assert_eq!(rig.stored().records[0].map(|record| record.0), Some(800));
        }
    }
}

/// STOP counts as CLEAR for the program of its sub-index, and for no other.
#[test]
fn stop_of_a_program_leaves_the_other_one_alone() {
    let mut rig = Rig::new(&STANDARD_2, 4096);
    for number in [1, 2] {
        rig.install(number, &raw(&STANDARD_2, number, 600));
    }
    rig.reset();
    rig.command(2, 0x00).unwrap();
    assert_eq!(rig.send(1, &raw(&STANDARD_2, 1, 700)), Err(MAN_BUSY));
    assert_eq!(rig.status(1), 0x08, "NOTCLEARED");
    rig.send_all(2, [&raw(&STANDARD_2, 2, 700)]);
    assert_eq!(rig.stored().records.map(|record| record.map(|record| record.0)), [Some(600), Some(700)]);
}
