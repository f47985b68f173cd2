//! The cost of signatures and ciphers: time on the bus, time before the start, stack, and no copy
//! of a secret in RAM. All times are virtual.

use canopen::program::ProgramControl;
use canopen::{Address, BitRate};
use coboot_tests::bench::{Bench, REQUEST, RESPONSE};
use coboot_tests::sealed_board::{board, open_board, provision, release, root, sealer, write, COUNTER, KEK};
use coboot_tests::throughput::{change_over, code};
use coboot_tests::{firmware, stack};
use coflash_core::device::access::challenge;
use coflash_core::device::{Doing, Transfers};
use coflash_core::file::sealed::Sealer;
use emulator::bus::Outcome;
use emulator::time::{Span, Time};
use hmac::{Hmac, KeyInit, Mac};
use seal::access::right;
use sha2::block_api::compress512;
use sha2::Sha512;

use super::{call_back, kinds, seal, start, status};

const READ_1000: [u8; 8] = [0x40, 0x00, 0x10, 0, 0, 0, 0, 0];
const READ_STATUS: [u8; 8] = [0x40, 0x57, 0x1F, 1, 0, 0, 0, 0];

fn micros(span: Span) -> u64 {
    span.0 / 1_000_000
}

/// A sealed board in its bootloader, at this bit rate.
fn board_at(rate: BitRate) -> Bench {
    let mut bench = open_board();
    change_over(&mut bench, rate);
    provision(&mut bench);
    bench.switch_on();
    bench.run_ms(50);
    bench
}

/// Sends a file in segments as fast as they are answered, and then reads 1000h and 1F57h in turn
/// until the device is idle; `look` gets the board between the latter requests. Returns the word of
/// 1F57h.
fn send_and_ask(bench: &mut Bench, file: &[u8], observe: &mut dyn FnMut(&Bench)) -> u32 {
    send(bench, file, usize::MAX);
    loop {
        observe(bench);
        assert_eq!(request(bench, READ_1000)[4..], [0, 0, 0, 0x10]);
        let word = status_word(bench);
        if word & 1 == 0 {
            return word;
        }
    }
}

fn request(bench: &mut Bench, data: [u8; 8]) -> Vec<u8> {
    bench.ask(REQUEST, &data, RESPONSE).unwrap_or_else(|| panic!("no answer to {data:02X?}"))
}

fn status_word(bench: &mut Bench) -> u32 {
    u32::from_le_bytes(request(bench, READ_STATUS)[4..].try_into().expect("four bytes"))
}

/// Sends CLEAR, and so many segments of a file, or all.
fn send(bench: &mut Bench, file: &[u8], segments: usize) {
    assert_eq!(request(bench, [0x2F, 0x51, 0x1F, 1, 3, 0, 0, 0])[0], 0x60);
    while status_word(bench) & 1 != 0 {}
    let [a, b, c, d] = (file.len() as u32).to_le_bytes();
    assert_eq!(request(bench, [0x21, 0x50, 0x1F, 1, a, b, c, d])[0], 0x60);
    let last = file.chunks(7).count() - 1;
    for (number, segment) in file.chunks(7).enumerate().take(segments) {
        let mut data = [0; 8];
        data[0] = (number as u8 & 1) << 4 | (7 - segment.len() as u8) << 1 | u8::from(number == last);
        data[1..=segment.len()].copy_from_slice(segment);
        let answer = request(bench, data);
        if answer[0] == 0x80 {
            break;
        }
        assert_eq!(answer[0], 0x20 | (number as u8 & 1) << 4);
    }
}

/// The four kinds of payload, each with its own counter: a repetition of the same image would be
/// discarded.
fn kinds_one_by_one() -> impl Iterator<Item = (&'static str, Sealer<'static>)> {
    let kinds = (COUNTER..).zip(kinds(COUNTER));
    kinds.map(|(counter, (what, sealer))| (what, Sealer { counter, ..sealer }))
}

/// The time between each request on the SDO channel and its answer, from the end of one frame to
/// the end of the other.
fn answers(bench: &Bench, from: Time) -> Vec<Span> {
    let mut asked = None;
    let mut all = Vec::new();
    for record in bench.records().into_iter().filter(|r| r.start >= from && r.outcome == Outcome::Good) {
        match record.frame.raw_id() {
            id if id == u32::from(REQUEST) => asked = Some(record.end),
            RESPONSE => all.extend(asked.take().map(|asked| record.end - asked)),
            _ => {}
        }
    }
    all
}

/// While signatures are checked, chunks hashed, decrypted and decompressed, sectors erased and
/// words written, every SDO request is answered within 5 ms.
#[test]
fn no_answer_takes_longer_than_5_ms() {
    let image = code(24);
    // The largest chunk: 8 KiB.
    let chunk = 13;
    for rate in [BitRate::K125, BitRate::K1000] {
        let mut bench = board_at(rate);
        bench.soil_programs();
        for (what, sealer) in kinds_one_by_one() {
            let file = Sealer { chunk, ..sealer }.seal(&image, &release()).expect("it can be sealed");
            let from = bench.time();
            let mut busy = 0;
            assert_eq!(send_and_ask(&mut bench, &file, &mut |_| busy += 1), status::OK, "{what}");
            let answers = answers(&bench, from);
            let slowest = answers.iter().copied().max().expect("answers");
            println!(
                "{rate:?}, {what}: {} answers, the slowest after {} us; {busy} looks behind the last segment",
                answers.len(),
                micros(slowest)
            );
            // Every segment was answered.
            assert!(answers.len() > file.len() / 7, "{what}");
            assert!(slowest <= Span::from_millis(5), "{rate:?}, {what}: {} us", micros(slowest));
        }
        bench.assert_nothing_unmodelled();
    }
}

/// 2002h (access): reading the challenge and writing a request, from the first request after the
/// boot-up on, and during the check of the request's signature.
#[test]
fn access_is_answered_within_5_ms() {
    for rate in [BitRate::K125, BitRate::K1000] {
        let mut bench = open_board();
        change_over(&mut bench, rate);
        provision(&mut bench);
        bench.switch_on();
        let from = bench.time();
        let asked = [right::STORE, 0, root().public().id()];
        let tbs = challenge(&mut bench.session()).unwrap().tbs(asked[0], asked[1], asked[2]);
        let request = [asked.map(u32::to_le_bytes).concat(), root().sign(&tbs).to_vec()].concat();
        let at = Address::new(0x2002, 2);
        bench.session().write(at, &request, Doing::Write(at), &mut |_| {}).unwrap();
        let mut granted = || challenge(&mut bench.session()).unwrap().granted() & right::STORE != 0;
        assert!((0..1000).any(|_| granted()), "the right is granted");
        let answers = answers(&bench, from);
        let slowest = answers.iter().copied().max().expect("answers");
        println!("{rate:?}: {} answers, 2002h after {} us at the latest", answers.len(), micros(slowest));
        assert!(slowest <= Span::from_millis(5), "{rate:?}: {} us", micros(slowest));
        assert!(answers.len() > 50, "{rate:?}: it was asked during the check");
        bench.assert_nothing_unmodelled();
    }
}

/// How long the device is busy with a head alone.
fn busy_with(bench: &mut Bench, head: &[u8], expected: u32) -> Span {
    let mut from = None;
    let word = send_and_ask(bench, head, &mut |bench| {
        from.get_or_insert(bench.time());
    });
    assert_eq!(word, expected);
    bench.time() - from.expect("it was looked at")
}

/// One signature is the difference between a head with one and a head with two signatures, both cut
/// off there.
#[test]
fn a_signature_takes_less_than_a_second() {
    let image = code(20);
    let certified = sealer(COUNTER).seal(&image, &release()).expect("it can be sealed");
    let by_the_root = Sealer { certificate: None, ..sealer(COUNTER) };
    let by_the_root = by_the_root.seal(&image, &root()).expect("it can be sealed");
    let mut took = Vec::new();
    for (file, head) in [(&by_the_root, 176 + 72), (&certified, 176 + 152 + 72)] {
        let mut bench = board_at(BitRate::K1000);
        // The constants that it computes while it is idle are ready.
        bench.run_ms(1000);
        took.push(busy_with(&mut bench, &file[..head], status::FORMAT));
    }
    let one = Span(took[1].0 - took[0].0);
    println!(
        "one signature takes {} ms; a head with one {} ms, with two {} ms",
        micros(one) / 1000,
        micros(took[0]) / 1000,
        micros(took[1]) / 1000
    );
    assert!(one <= Span::from_millis(1000), "{} us", micros(one));
    assert!(one >= Span::from_millis(20), "nothing was looked at: {} us", micros(one));
}

/// The budget of the design: 5 ms, with a CRC of a whole program of 400 KiB. The signature was
/// checked at the installation.
#[test]
fn a_sealed_program_of_400_kib_is_started_within_5_ms() {
    let mut bench = board_at(BitRate::K1000);
    let file = sealer(COUNTER).seal(&code(400), &release()).expect("it can be sealed");
    assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    call_back(&mut bench);
    bench.power_off();
    bench.run_ms(10);
    let took = bench.power_on_to_first_instruction();
    println!("reset to the first instruction of a sealed program of 400 KiB: {} us", micros(took));
    assert!(took <= Span::from_millis(5), "{} us", micros(took));
    assert!(took >= Span::from_millis(1), "its CRC takes a part of it: {} us", micros(took));
}

/// As fast as without the feature: 15 ms after power-on, 30 ms after the answer to 80h.
#[test]
fn the_bootloader_is_there_as_soon_as_an_open_one() {
    let mut bench = board();
    let power_on = bench.switch_on() - Time(0);
    let file = seal(&sealer(COUNTER), firmware::APP_V1);
    assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK));
    start(&mut bench, firmware::APP_V1, "1.0.0");
    call_back(&mut bench);
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.await_boot_up(1000);
    bench.session().command(1, ProgramControl::StartBootloader).unwrap();
    let answered = bench.time();
    let call_back = bench.await_boot_up(1000) - answered;
    println!(
        "boot-up: {} us after power-on, {} us after the answer to 80h",
        micros(power_on),
        micros(call_back)
    );
    assert!(power_on <= Span::from_millis(15), "{} us", micros(power_on));
    assert!(call_back <= Span::from_millis(30), "{} us", micros(call_back));
}

/// No update of any kind uses more than 4 KiB of the stack.
#[test]
fn updates_take_4_kib_of_the_stack_at_most() {
    const MOST: u32 = 4096;
    let stack = stack::of_image(firmware::BOOTLOADER_SEALED);
    assert!(stack.size >= 2 * MOST, "the stack has {} bytes", stack.size);
    let mut bench = board_at(BitRate::K1000);
    stack::fill(bench.machine(), stack);
    for (what, sealer) in kinds_one_by_one() {
        let file = sealer.seal(&code(20), &release()).expect("it can be sealed");
        assert_eq!(write(&mut bench, &file, Transfers::Blocks), (None, status::OK), "{what}");
    }
    let depth = stack::depth(bench.machine(), stack);
    println!("the stack has {} bytes, of which {depth} are used", stack.size);
    assert!(depth <= MOST, "{depth} bytes of the stack are used");
}

/// Eight bytes of each secret, in the order of memory or of SHA-512's words (FIPS 180-4: most significant byte
/// first).
struct Traces(Vec<[u8; 8]>);

impl Traces {
    fn of(secrets: &[&[u8]]) -> Self {
        let parts = secrets.iter().flat_map(|secret| secret.windows(8));
        let traces = parts.map(|part| <[u8; 8]>::try_from(part).expect("eight bytes"));
        Self(traces.flat_map(|trace| [trace, u64::from_le_bytes(trace).to_be_bytes()]).collect())
    }

    /// Whether memory has one.
    fn are_in(&self, memory: &[u8]) -> bool {
        let two = |bytes: &[u8]| usize::from(bytes[0]) << 8 | usize::from(bytes[1]);
        // All of the RAM is searched at each look: few places begin as a trace does.
        let mut begins = vec![false; 1 << 16];
        self.0.iter().for_each(|trace| begins[two(trace)] = true);
        memory.windows(8).any(|window| begins[two(window)] && self.0.iter().any(|trace| trace == window))
    }

    /// Whether the RAM has one, that of the core included.
    fn are_left(&self, bench: &Bench) -> bool {
        let chip = firmware::board().chip;
        [chip.sram, chip.ccm].into_iter().any(|ram| {
            let mut bytes = vec![0; ram.size as usize];
            bench.world.machine(bench.device).read_memory(ram.base, &mut bytes).expect("it is RAM");
            self.are_in(&bytes)
        })
    }
}

/// The first state of SHA-512 (FIPS 180-4, 5.3.5).
#[rustfmt::skip]
const FIRST_STATE: [u64; 8] = [
    0x6a09_e667_f3bc_c908, 0xbb67_ae85_84ca_a73b, 0x3c6e_f372_fe94_f82b, 0xa54f_f53a_5f1d_36f1,
    0x510e_527f_ade6_82d1, 0x9b05_688c_2b3e_6c1f, 0x1f83_d9ab_fb41_bd6b, 0x5be0_cd19_137e_2179,
];

/// What opens other images, and what opens this encrypted one alone, by RFC 2104 and the layout of the file: the
/// key-encryption key, plain and as HMAC uses it, and the states of HMAC after it; the stream that wraps the
/// key of the image, and this key.
fn secrets(file: &[u8]) -> (Traces, Traces) {
    let masked = [0x36, 0x5C].map(|mask| std::array::from_fn(|at| KEK.get(at).unwrap_or(&0) ^ mask));
    let states = masked.map(|block: [u8; 128]| {
        let mut state = FIRST_STATE;
        compress512(&mut state, &[block]);
        state.map(u64::to_be_bytes).concat()
    });
    let mut mac = Hmac::<Sha512>::new_from_slice(&KEK).expect("any length");
    mac.update(b"coboot key 1\0");
    mac.update(&file[104..120]);
    let stream = mac.finalize().into_bytes();
    // The manifest has one record: tag, length, id of the key, check, wrapped key.
    let key: Vec<u8> =
        file[176 + 16..][..32].iter().zip(&stream).map(|(wrapped, stream)| wrapped ^ stream).collect();
    let of_all = Traces::of(&[&KEK, &masked[0][..32], &masked[1][..32], &states[0], &states[1]]);
    (of_all, Traces::of(&[&stream[..32], &key]))
}

/// The key-encryption key is only in flash, and the key of an image in RAM while it is installed: RAM can be
/// read out of a chip with protected flash.
#[test]
fn no_secret_outlives_its_use() {
    let [_, (_, encrypted), ..] = kinds(COUNTER);
    let seal = |image: &[u8]| encrypted.seal(image, &release()).expect("it can be sealed");
    let (file, other) = (seal(&code(20)), seal(&code(24)));
    let (of_all, of_file) = secrets(&file);
    let (_, of_other) = secrets(&other);
    let mut bench = board_at(BitRate::K1000);
    assert!(of_all.are_in(bench.machine().flash()), "it is found where it is");
    let mut looks = 0;
    let mut observe = |bench: &Bench| {
        assert!(!of_all.are_left(bench), "look {looks}");
        looks += 1;
    };
    assert_eq!(send_and_ask(&mut bench, &file, &mut observe), status::OK);
    assert!(looks >= 2);
    let mut left = Vec::new();
    let mut observe = |bench: &mut Bench, what: &'static str| {
        let found = [&of_all, &of_file, &of_other].map(|traces| traces.are_left(bench));
        if found.contains(&true) {
            left.push((what, found));
        }
    };
    observe(&mut bench, "after the installation");
    bench.session().command(1, ProgramControl::Start).unwrap();
    bench.run_to_first_instruction();
    observe(&mut bench, "at the start of the program");
    bench.await_boot_up(1_000);
    call_back(&mut bench);

    // The same image again erases nothing: after a reset in the middle the program starts at once.
    send(&mut bench, &file, file.len() / 14);
    bench.run_ms(20);
    assert!(of_file.are_left(&bench), "in use");
    bench.machine().reset_pin();
    bench.run_to_first_instruction();
    observe(&mut bench, "in a program after a reset in the middle");
    bench.await_boot_up(1_000);
    call_back(&mut bench);

    for what in ["an abort by the client", "a reset", "CLEAR"] {
        send(&mut bench, &other, other.len() / 14);
        bench.run_ms(20);
        assert!(of_other.are_left(&bench), "{what}: in use");
        match what {
            "an abort by the client" => bench.post(REQUEST, &[0x80, 0x50, 0x1F, 1, 0, 0, 0, 8]),
            "CLEAR" => bench.session().command(1, ProgramControl::Clear).unwrap(),
            _ => bench.machine().reset_pin(),
        }
        bench.run_ms(2_000);
        observe(&mut bench, what);
    }
    // A second CLEAR without data needs a right.
    bench.machine().reset_pin();
    bench.await_boot_up(1_000);
    let mut broken = other.clone();
    *broken.last_mut().unwrap() ^= 1;
    let word = send_and_ask(&mut bench, &broken, &mut |_| {});
    assert_eq!(word, status::SIGNATURE);
    observe(&mut bench, "a refusal");
    assert!(left.is_empty(), "[secrets of all, of the first image, of the other one]: {left:#?}");
}
