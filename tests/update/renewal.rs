//! `coflash` renews the bootloader of a device while its program stays (docs/renewal.md).

use canopen::program::{ProgramControl, PROGRAM_DATA};
use canopen::Address;
use coboot_tests::bench::{Bench, NODE};
use coboot_tests::renewal::{confirm, image_of, number, plain, progress, running, stage, start, version};
use coboot_tests::{firmware, sealed_board};
use coflash_core::device::{info, Doing};
use coflash_core::update::event::Phase;
use coflash_core::update::{flash, Event, FlashOptions, Password, Payload, Renewal};
use coflash_core::Error;
use emulator::machine::{Cut, FlashCut, Operation};
use shared_abi::handoff::ResetCause;
use shared_abi::ram_image::Version;
use shared_abi::renewal::{Origin, State, TrialEnd};

const NEW: u32 = 0x0009_0001;

/// A board that runs version 1 of the application.
fn board() -> Bench {
    let mut bench = Bench::new().switched_on();
    install(&mut bench, firmware::APP_V1);
    bench
}

fn install(bench: &mut Bench, program: &str) {
    flash(&mut bench.session(), firmware::blocks(program), &FlashOptions::default(), &mut |_| {}).unwrap();
    assert!(!bench.is_bootloader(NODE));
}

fn renewed(bench: &mut Bench, new: &Payload) -> (Result<Renewal, Error>, Vec<Phase>) {
    let mut phases = Vec::new();
    let result = flash(&mut bench.session(), new, &FlashOptions::default(), &mut |event| {
        if let Event::Phase(phase) = event {
            phases.push(phase);
        }
    });
    (result.map(|report| report.renewal.unwrap()), phases)
}

fn call_back(bench: &mut Bench) {
    coflash_core::update::steps::call_back(&mut bench.session()).unwrap();
}

#[test]
fn a_running_device_gets_a_new_bootloader_and_runs_again() {
    let mut bench = board();
    let new = plain(&version(firmware::BOOTLOADER, NEW));
    let (result, phases) = renewed(&mut bench, &new);
    let renewal = result.unwrap();
    let expected = (number(), Version(1), Version(NEW), false, true);
    let Renewal { number, from, to, unchanged, running: again, .. } = renewal;
    assert_eq!((number, from, to, unchanged, again.is_some()), expected);
    assert!(
        matches!(
            phases[..],
            [
                Phase::CallingBack,
                Phase::InBootloader,
                Phase::Renewing { from: 1, to: NEW, .. },
                Phase::Staged,
                Phase::OnTrial,
                Phase::Installed { version: NEW },
                Phase::Starting,
                Phase::Started(_),
            ]
        ),
        "{phases:?}"
    );
    assert!(!bench.is_bootloader(NODE));
    call_back(&mut bench);
    assert_eq!(running(&mut bench), NEW);
    let info = info(&mut bench.session()).unwrap();
    assert_eq!(info.programs.len(), firmware::board().programs.len(), "the bootloader is none of them");
    assert!(
        info.to_string().contains("bootloader        version 9.1, services 2, renewed as program 2"),
        "{info}"
    );
    // The same again changes nothing.
    bench.machine().keep_flash_log();
    let (again, _) = renewed(&mut bench, &new);
    assert!(again.unwrap().unchanged);
    assert_eq!(bench.machine().take_flash_log(), []);
    install(&mut bench, firmware::APP_V2);
}

/// The old bootloader is back, and the program runs again.
#[test]
fn a_bootloader_that_does_not_come_up_is_named_with_the_reason() {
    let mut bench = board();
    // Its Reset leads to a branch to itself.
    let mut image = version(firmware::BOOTLOADER, NEW);
    let reset = u32::from_le_bytes(image[68..72].try_into().unwrap()) & !1;
    let at = 64 + (reset - firmware::board().ram.base) as usize;
    image[at..at + 2].copy_from_slice(&0xE7FE_u16.to_le_bytes());
    let hangs = coboot_tests::renewal::with_crc(image);
    let (result, _) = renewed(&mut bench, &plain(&hangs));
    let end = TrialEnd::Reset(ResetCause::IndependentWatchdog);
    let Err(error @ Error::RenewalFailed { .. }) = result else { panic!("{result:?}") };
    assert!(matches!(error, Error::RenewalFailed { end: found, .. } if found == end));
    let words = "the new bootloader of node 1 ended by a reset: the independent watchdog; the old one runs";
    assert_eq!(error.to_string(), words);
    assert!(!bench.is_bootloader(NODE), "the program runs again");
    call_back(&mut bench);
    assert_eq!(progress(&mut bench).state, State::Staged);
    // A good one goes through then.
    renewed(&mut bench, &plain(&version(firmware::BOOTLOADER, NEW))).0.unwrap();
}

/// The power fails while the device installs the new bootloader.
#[test]
fn an_interrupted_renewal_goes_on_when_it_is_started_again() {
    let new = plain(&version(firmware::BOOTLOADER, NEW));
    let words = u64::from(new.size()) / 4;
    for operation in [words / 2, words + words / 2] {
        let mut bench = board();
        bench.machine().cut_power_at(Some(FlashCut { operation, when: Cut::Torn { seed: 7 } }));
        assert!(renewed(&mut bench, &new).0.is_err());
        bench.machine().cut_power_at(None);
        bench.power_cycle();
        bench.await_program(1000);
        renewed(&mut bench, &new).0.unwrap();
        call_back(&mut bench);
        assert_eq!((running(&mut bench), progress(&mut bench).state), (NEW, State::Installed));
    }
}

/// What an earlier renewal has left: the image that was installed and still runs from staging; a trial
/// that somebody has left open; an image over which another download was broken off; and what a tool
/// has done that knows nothing of this one.
#[test]
fn a_renewal_goes_on_from_what_another_one_has_left() {
    const NEXT: u32 = 0x0009_0002;
    let first = version(firmware::BOOTLOADER, NEW);
    let to = |bench: &mut Bench, to| renewed(bench, &plain(&version(firmware::BOOTLOADER, to))).0.unwrap();
    let mut bench = Bench::new().switched_on();
    assert_eq!(to(&mut bench, NEW).to, Version(NEW));
    let Renewal { unchanged, from, .. } = to(&mut bench, NEW);
    assert_eq!((unchanged, from), (true, Version(NEW)));
    let Renewal { unchanged, from, to: next, .. } = to(&mut bench, NEXT);
    assert_eq!((unchanged, from, next), (false, Version(NEW), Version(NEXT)));
    assert!(bench.is_bootloader(NODE));
    bench.assert_nothing_unmodelled();

    // The same image is confirmed, another one is given up first.
    for wanted in [NEW, NEXT] {
        let mut bench = Bench::new().switched_on();
        stage(&mut bench, &first);
        start(&mut bench);
        assert_eq!(progress(&mut bench).origin, Origin::Trial);
        assert_eq!(to(&mut bench, wanted).to, Version(wanted));
        assert_eq!((running(&mut bench), progress(&mut bench).state), (wanted, State::Installed));
    }

    let mut bench = Bench::new().switched_on();
    stage(&mut bench, &first);
    bench.session().command(number(), ProgramControl::Clear).unwrap();
    let mut broken = version(firmware::BOOTLOADER, NEXT);
    broken[2000] ^= 1;
    let at = Address::new(PROGRAM_DATA, number());
    let _ = bench.session().write(at, &broken, Doing::Write(at), &mut |_| {});
    bench.session().await_idle(number(), Doing::Write(at)).unwrap();
    assert_eq!(progress(&mut bench).state, State::None);
    assert!(!to(&mut bench, NEW).unchanged);
    assert_eq!(running(&mut bench), NEW);

    let mut bench = Bench::new().switched_on();
    stage(&mut bench, &first);
    start(&mut bench);
    confirm(&mut bench);
    assert!(to(&mut bench, NEW).unchanged);
}

/// Each program that it installs would have another CRC than the resident part computes.
#[test]
fn a_bootloader_for_another_resident_part_is_refused_and_named() {
    let mut bench = board();
    call_back(&mut bench);
    bench.machine().keep_flash_log();
    let (result, _) = renewed(&mut bench, &plain(&image_of(firmware::BOOTLOADER_CRC_16)));
    let error = result.unwrap_err();
    assert!(
        error.to_string().contains("was built for a resident part that decides by other choices"),
        "{error}"
    );
    assert!(error.advice().to_string().contains("built for its resident part"), "{}", error.advice());
    assert_eq!(bench.machine().take_flash_log(), []);
    install(&mut bench, firmware::APP_V2);
}

/// A sealed device takes a sealed one alone.
#[test]
fn an_unsigned_bootloader_is_refused_before_the_call() {
    let mut bench = sealed_board::board().switched_on();
    bench.machine().keep_flash_log();
    let (result, _) = renewed(&mut bench, &plain(&version(firmware::BOOTLOADER, NEW)));
    assert!(matches!(result, Err(Error::SealedOnly { .. })), "{result:?}");
    let erased = |operation: &Operation| matches!(operation, Operation::Erase { .. });
    assert!(!bench.machine().take_flash_log().iter().any(erased));
}

/// A bootloader with a password, at this node: with the right one it is renewed, with another one refused
/// before anything is erased.
fn assert_wants_a_password(bootloader: &str, node: u8, right: Option<&str>, others: &[Option<&str>]) {
    let mut bench = Bench::of_image(bootloader);
    bench.power_on();
    bench.await_boot_up_of(node, 100);
    let new = plain(&version(bootloader, NEW));
    let renewed = |bench: &mut Bench, password: Option<&str>| {
        let options = FlashOptions::default().unlock(password.and_then(Password::new));
        let report = flash(&mut bench.session_with(node), &new, &options, &mut |_| {});
        report.map(|report| report.renewal.unwrap())
    };
    bench.machine().keep_flash_log();
    for other in others {
        let error = renewed(&mut bench, *other).unwrap_err();
        let is_unlock = matches!(error, Error::Refused { doing: Doing::Unlock, .. });
        assert!(is_unlock || matches!(error, Error::NoPassword { .. }), "{other:?}: {error}");
        assert!(error.advice().to_string().contains("password"), "{}", error.advice());
        // The next attempt must wait.
        bench.run_ms(600);
    }
    assert_eq!(bench.machine().take_flash_log(), []);
    let Renewal { to, unchanged, .. } = renewed(&mut bench, right).unwrap();
    assert_eq!((to, unchanged), (Version(NEW), false));
    let now = info(&mut bench.session_with(node)).unwrap().bootloader.unwrap();
    assert_eq!(
        (now.version, now.running.map(|running| running.progress.state)),
        (Version(NEW), Some(State::Installed))
    );
    bench.assert_nothing_unmodelled();
}

/// The default password of ESAcademy's boot loader is INIT, and the tool knows it. A lift has one of its
/// own; this repository's is "coboot".
#[test]
fn a_bootloader_with_a_password_is_renewed_with_it_and_refused_without() {
    assert_wants_a_password(firmware::BOOTLOADER_ESACADEMY, 64, None, &[Some("0x57726F6E")]);
    assert_wants_a_password(firmware::BOOTLOADER_LIFT, 126, Some("coboot"), &[None, Some("Coboot")]);
}
