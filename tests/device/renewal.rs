//! The bootloader is renewed over CAN, with the built firmware: a new RAM image waits in staging, runs once
//! on trial, and is installed at home after its confirmation (docs/renewal.md).

use canopen::program::{
    FlashError, FlashStatus, ProgramControl, ProgramStart, DEVICE_STATE, PROGRAM_DATA, PROGRAM_ID,
    PROGRAM_VERSION, STATE_BOOTLOADER, STATE_PROGRAM_START,
};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE, REQUEST, RESPONSE};
use coboot_tests::firmware;
use coboot_tests::renewal::{
    cells, confirm, crc_of, identification, image_of, number, progress, running, stage, start, status,
    version, with_crc,
};
use coflash_core::device::Doing;
use coflash_core::update::{flash, FlashOptions};
use emulator::machine::{Cut, FlashCut, Operation, Options, Stop};
use emulator::silicon::WORST;
use emulator::time::Span;
use shared_abi::geometry::Region;
use shared_abi::handoff::ResetCause;
use shared_abi::ram_image::Header;
use shared_abi::renewal::{Origin, Progress, State, TrialEnd};
use shared_abi::warm_start::Damage;

/// An image for this board with code of its own: all its vectors lead there.
fn made_of(code: &[u16]) -> Vec<u8> {
    let real = image_of(firmware::BOOTLOADER);
    let word = |at: usize| u32::from_le_bytes(real[at..at + 4].try_into().unwrap());
    let (ram_base, ram_end) = (word(16), word(20));
    let mut body: Vec<u8> = ram_end.to_le_bytes().to_vec();
    body.extend((1..16).flat_map(|_| (ram_base + 0x41).to_le_bytes()));
    body.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    body.resize(body.len().next_multiple_of(4), 0);
    let mut image = real[..Header::SIZE as usize].to_vec();
    image[12..16].copy_from_slice(&(body.len() as u32).to_le_bytes());
    image.extend(body);
    with_crc(image)
}

/// The version of the new images.
const NEW: u32 = 0x0009_0001;
/// A branch to itself (ARMv7-M A7.7.12).
const HANGS: [u16; 1] = [0xE7FE];
/// An undefined instruction; its fault handler is the same, so the core locks up.
const FAULTS: [u16; 1] = [0xDE00];
/// Writes SYSRESETREQ to AIRCR (B3.2.6): two loads of the literals at the end, a store.
const RESETS: [u16; 8] = [0x4801, 0x4902, 0x6001, 0xE7FE, 0xED0C, 0xE000, 0x0004, 0x05FA];

/// A board with a program that has shown that it comes back, in the bootloader.
fn board() -> Bench {
    let mut bench = Bench::new().switched_on();
    bench.install(firmware::APP_V1);
    bench.confirm_program();
    call_back(&mut bench);
    bench
}

fn call_back(bench: &mut Bench) {
    bench.call_back();
    assert!(bench.is_bootloader(NODE));
    bench.events();
}

fn home(size: usize) -> Region {
    Region::new(firmware::board().home.unwrap().base, size as u32)
}

fn power_cycle(bench: &mut Bench) {
    bench.power_cycle();
    bench.run_ms(500);
}

/// The main job. The program is untouched, and starts as fast as before.
#[test]
fn a_new_bootloader_is_installed_while_the_program_stays() {
    let mut bench = board();
    assert_eq!(bench.number(DEVICE_STATE, STATE_BOOTLOADER), u32::from(number()));
    let old = image_of(firmware::BOOTLOADER);
    assert_eq!((progress(&mut bench), identification(&mut bench)), (Progress::default(), crc_of(&old)));
    let program = Region::new(firmware::board().programs[0].base, 32 * 1024);
    let before = cells(&bench, program);
    bench.power_off();
    let starts = bench.power_on_to_first_instruction();
    bench.await_program(1000);
    call_back(&mut bench);

    let new = version(firmware::BOOTLOADER, NEW);
    stage(&mut bench, &new);
    assert_eq!(cells(&bench, home(old.len())), old, "home is untouched");
    let silence = start(&mut bench);
    assert!(silence <= Span::from_millis(25), "{silence:?}");
    let trial = Progress { state: State::Staged, origin: Origin::Trial, ..Progress::default() };
    assert_eq!((progress(&mut bench), identification(&mut bench)), (trial, crc_of(&new)));
    let from = bench.time();
    confirm(&mut bench);
    // Each answer while home is erased and written.
    let asked = bench.frames_of(REQUEST.into(), from).into_iter();
    let answers = bench.frames_of(RESPONSE, from);
    let slowest = asked.zip(answers).map(|((asked, _), (answered, _))| answered - asked).max().unwrap();
    assert!(slowest <= Span::from_millis(5), "{slowest:?}");
    assert_eq!(cells(&bench, home(new.len())), new);

    // Programs start as before, and the new image is the bootloader.
    bench.events();
    bench.power_off();
    // The journal has four more values, which the boot stage searches.
    let later = bench.power_on_to_first_instruction().0 - starts.0;
    assert!(later <= Span::from_micros(200).0, "{later}");
    bench.await_program(1000);
    assert_eq!(cells(&bench, program), before);
    call_back(&mut bench);
    let installed = Progress { state: State::Installed, ..Progress::default() };
    assert_eq!((progress(&mut bench), identification(&mut bench)), (installed, crc_of(&new)));
    bench.assert_nothing_unmodelled();
}

/// The fastest LSI makes the watchdog of the option bytes short (349 ms as it comes out of reset), and the slowest flash
/// makes each erase long: the only reset of a renewal is the one of START.
#[test]
fn the_watchdog_of_the_option_bytes_bites_in_no_step_of_a_renewal() {
    let mut bench = Bench::with(Options { silicon: WORST, ..Options::default() });
    bench.machine().set_hardware_watchdog(true);
    bench.switch_on();
    let new = version(firmware::BOOTLOADER, NEW);
    stage(&mut bench, &new);
    assert_eq!(bench.events(), []);
    start(&mut bench);
    let events = bench.events();
    assert!(matches!(events[..], [(_, Stop::Reset(emulator::machine::ResetCause::Software))]), "{events:?}");
    confirm(&mut bench);
    bench.run_ms(1000);
    assert_eq!(bench.events(), []);
    assert_eq!(cells(&bench, home(new.len())), new);
    assert_eq!(progress(&mut bench).state, State::Installed);
    bench.assert_nothing_unmodelled();
}

/// Between its confirmation and the next start from home a reset is an ordinary one, not the end of a trial.
#[test]
fn a_reset_after_the_confirmation_starts_the_program() {
    let new = version(firmware::BOOTLOADER, NEW);
    let mut bench = board();
    stage(&mut bench, &new);
    start(&mut bench);
    confirm(&mut bench);
    bench.machine().reset_pin();
    bench.await_program(1000);
    call_back(&mut bench);
    let installed = Progress { state: State::Installed, ..Progress::default() };
    assert_eq!((progress(&mut bench), identification(&mut bench)), (installed, crc_of(&new)));
}

/// Anybody can write NMT, and each reset would erase home once more.
#[test]
fn an_nmt_reset_waits_for_an_installation() {
    let new = version(firmware::BOOTLOADER, NEW);
    let mut bench = board();
    stage(&mut bench, &new);
    start(&mut bench);
    bench.events();
    bench.machine().keep_flash_log();
    bench.session().command(number(), ProgramControl::SetSignature).unwrap();
    for _ in 0..50 {
        bench.post(0x000, &[0x81, NODE]);
        bench.run_ms(100);
    }
    assert_eq!(cells(&bench, home(new.len())), new);
    let sector = firmware::board().chip.sector_at(home(1).base).unwrap();
    let log = bench.machine().take_flash_log();
    let erases = |operation: &&Operation| matches!(operation, Operation::Erase { sectors } if sectors.contains(&sector));
    assert_eq!(log.iter().filter(erases).count(), 1);
    assert!(!bench.events().is_empty(), "the reset came in the end");
}

/// A bootloader with a visible change: another product for this board, whose code is at other addresses.
#[test]
fn the_image_may_differ_in_every_address() {
    let mut bench = board();
    let other = image_of(firmware::BOOTLOADER_WATCHDOG);
    let watchdog = |bench: &mut Bench| {
        let word = bench.number(DEVICE_STATE, STATE_PROGRAM_START);
        ProgramStart::of_word(word).watchdog_ms
    };
    assert_eq!(watchdog(&mut bench), 0);
    stage(&mut bench, &other);
    start(&mut bench);
    assert_eq!(watchdog(&mut bench), 1000);
    confirm(&mut bench);
    power_cycle(&mut bench);
    assert!(!bench.is_bootloader(NODE));
    call_back(&mut bench);
    assert_eq!(watchdog(&mut bench), 1000);
}

/// RAM outlives a short dip of the supply. It is a power-on all the same: the program starts.
#[test]
fn a_short_dip_of_the_supply_in_a_trial_is_a_power_on() {
    let mut bench = board();
    stage(&mut bench, &version(firmware::BOOTLOADER, NEW));
    start(&mut bench);
    bench.machine().set_supply(0, Span(0));
    bench.run_ms(1);
    bench.machine().set_supply(3_300, Span(0));
    bench.run_ms(500);
    let resets = bench.stops();
    assert!(resets.contains(&Stop::Reset(emulator::machine::ResetCause::PowerOn)), "{resets:?}");
    assert!(!bench.is_bootloader(NODE), "the program starts");
}

/// The power fails while home is written, with a program that has a rescue window: the window does not end the
/// installation, and until it is done the callgate says what the device runs.
#[test]
fn an_installation_that_a_cut_has_left_is_completed_before_the_program_starts() {
    let new = version(firmware::BOOTLOADER, NEW);
    let blocks = firmware::blocks(firmware::APP_V1);
    let at = |index| Address::new(index, number());
    let mut lacks_header = false;
    // The seven words of a record come before the erase.
    let erase = 7 * u64::from(4 / bsp::FLASH_WIDTH);
    for (confirmed, operation) in [(true, erase), (true, erase + 1), (true, 2_000), (false, 2_000)] {
        let mut bench = if confirmed { board() } else { Bench::new() };
        if !confirmed {
            bench.switch_on();
        }
        stage(&mut bench, &new);
        start(&mut bench);
        if !confirmed {
            // On trial, so that nobody has called this program back.
            let stays = FlashOptions::default().trial_run(false).start(false);
            flash(&mut bench.session(), &blocks, &stays, &mut |_| {}).unwrap();
            bench.session().command(1, ProgramControl::SetSignature).unwrap();
            bench.session().await_idle(1, Doing::Program).unwrap();
        }
        let when = Cut::After;
        bench.machine().cut_power_at(Some(FlashCut { operation, when }));
        let _ = bench.session().command(number(), ProgramControl::SetSignature);
        bench.run_ms(3_000);
        bench.machine().cut_power_at(None);
        let left = cells(&bench, home(new.len()));
        assert!(left != new, "the cut came too late");
        lacks_header |= left[4..8] == [0xFF; 4];
        power_cycle(&mut bench);
        if confirmed {
            assert!(!bench.is_bootloader(NODE));
            assert_eq!(bench.session().read_number(at(PROGRAM_ID)).unwrap(), crc_of(&new));
            assert_eq!(bench.session().read_number(at(PROGRAM_VERSION)).unwrap(), NEW);
            call_back(&mut bench);
            bench.session().await_idle(number(), Doing::Installation).unwrap();
        } else {
            bench.run_ms(10_000);
            assert!(!bench.is_bootloader(NODE), "the program starts in the end");
        }
        let is_whole = cells(&bench, home(new.len())) == new;
        assert!(is_whole, "confirmed: {confirmed}");
    }
    assert!(lacks_header, "no cut came directly after the erase");
}

/// Images that are deaf, hang, fault or reset: the old bootloader answers, says why, and keeps its home.
#[test]
fn an_image_that_does_not_work_ends_by_itself() {
    for (case, image, end) in [
        ("hangs", made_of(&HANGS), TrialEnd::Reset(ResetCause::IndependentWatchdog)),
        ("locks up", made_of(&FAULTS), TrialEnd::Reset(ResetCause::IndependentWatchdog)),
        ("resets", made_of(&RESETS), TrialEnd::Reset(ResetCause::Software)),
        ("of another resident part", made_of(&HANGS), TrialEnd::Damaged(Damage::Facts)),
    ] {
        let mut bench = board();
        let old = crc_of(&image_of(firmware::BOOTLOADER));
        stage(&mut bench, &image);
        if end == TrialEnd::Damaged(Damage::Facts) {
            // An older bootloader would have let it in.
            let facts = firmware::board().staging.unwrap().base + Header::FACTS;
            bench.machine().load_bin(facts, &[0; 4]).unwrap();
        }
        start(&mut bench);
        let over = Progress { state: State::Staged, origin: Origin::Home, trial_end: end };
        assert_eq!((progress(&mut bench), identification(&mut bench)), (over, old), "{case}");
        assert!(bench.is_bootloader(NODE), "{case}");
        let crashes = bench.number(DEVICE_STATE, 4);
        assert_eq!(crashes, 0, "{case}: no program has crashed");
        power_cycle(&mut bench);
        assert!(!bench.is_bootloader(NODE), "{case}: the program starts");
    }
}

/// The real image, with the power of its reach taken away in different ways.
#[test]
fn a_trial_that_nobody_confirms_ends() {
    let new = version(firmware::BOOTLOADER, NEW);
    let mut bench = board();
    stage(&mut bench, &new);
    // Nobody speaks to it for a minute.
    start(&mut bench);
    bench.run_ms(58_000);
    assert_eq!(progress(&mut bench).origin, Origin::Trial);
    bench.await_boot_up(3_000);
    let over = |trial_end| Progress { state: State::Staged, origin: Origin::Home, trial_end };
    assert_eq!(progress(&mut bench), over(TrialEnd::Late));
    // It is deaf, and nobody acknowledges its frames: another bit rate.
    start(&mut bench);
    bench.run_ms(50);
    bench.set_host_bit_rate(500_000);
    bench.run_ms(61_000);
    bench.set_host_bit_rate(125_000);
    bench.run_ms(6_000);
    assert_eq!(progress(&mut bench), over(TrialEnd::Late));
    // A fault in it.
    start(&mut bench);
    bench.run_ms(20);
    bench.replace_idle(FAULTS[0]);
    bench.await_boot_up(3_000);
    assert_eq!(progress(&mut bench), over(TrialEnd::Reset(ResetCause::Software)));
    // It stops to feed the watchdog.
    start(&mut bench);
    bench.run_ms(20);
    bench.replace_idle(HANGS[0]);
    bench.await_boot_up(5_000);
    assert_eq!(progress(&mut bench), over(TrialEnd::Reset(ResetCause::IndependentWatchdog)));
    // A master gives it up.
    start(&mut bench);
    bench.session().command(number(), ProgramControl::ClrSignature).unwrap();
    bench.await_boot_up(1_000);
    assert_eq!(progress(&mut bench), over(TrialEnd::GivenUp));
    // The power fails.
    start(&mut bench);
    power_cycle(&mut bench);
    assert!(!bench.is_bootloader(NODE), "the program starts");
    call_back(&mut bench);
    assert_eq!(progress(&mut bench).origin, Origin::Home);
    assert_eq!(running(&mut bench), 1);
    start(&mut bench);
    confirm(&mut bench);
}

/// What cannot run here is refused, and the old image stays.
#[test]
fn a_wrong_image_is_refused_before_an_erase() {
    let mut bench = board();
    let spare = version(firmware::BOOTLOADER, NEW);
    stage(&mut bench, &spare);
    let staging = Region::new(firmware::board().staging.unwrap().base, spare.len() as u32);
    let mut bench_image = image_of(firmware::BOOTLOADER);
    bench_image[4..8].fill(0);
    let mut other_board = bench_image.clone();
    other_board[32] ^= 1;
    let other_facts = Damage::Facts as u16;
    for (wrong, detail) in [
        (bench_image, 0),
        (with_crc(other_board), 0),
        // It would never end its trial.
        (image_of(firmware::BOOTLOADER_LEAST), other_facts),
        // Programs that it installs would not start: the resident part computes CRC-32.
        (image_of(firmware::BOOTLOADER_CRC_16), other_facts),
        // They need more than the resident part has: the loader in the ROM, nameplates.
        (image_of(firmware::BOOTLOADER_WAYS_IN), 0),
        (image_of(firmware::BOOTLOADER_SWITCHES), 0),
    ] {
        let at = Address::new(PROGRAM_DATA, number());
        bench.session().command(number(), ProgramControl::Clear).unwrap();
        let _ = bench.session().write(at, &wrong, Doing::Write(at), &mut |_| {});
        let FlashStatus { error, detail: found, .. } = status(&mut bench);
        assert_eq!((error, found), (Some(FlashError::Format), detail));
        assert_eq!(progress(&mut bench).state, State::Staged);
        assert_eq!(cells(&bench, staging), spare);
    }
    assert_eq!(bench.events().into_iter().filter(|(_, stop)| matches!(stop, Stop::Reset(_))).count(), 0);
}
