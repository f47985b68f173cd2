//! Over-drive of the regulator (RM0090 section 5.1.4, RM0390).

use shared_abi::geometry::{Geometry, STM32F427VG, STM32F429ZI, STM32F446RE, STM32F469NI};

use super::*;

/// Bits of the program's argument.
const NONE: u32 = 1;
const HASTY: u32 = 2;
const OFF_AT_SPEED: u32 = 4;

/// [`programs::OVER_DRIVE`] after 10 ms.
fn ran_on(chip: &'static Geometry, argument: u32, options: Options) -> Machine {
    let mut machine = Machine::new(chip, options).unwrap();
    load(&mut machine, &programs::OVER_DRIVE);
    machine.power_on(Time(0));
    put(&mut machine, ARGUMENT, argument);
    machine.run_until(ms(30));
    machine
}

fn what(machine: &Machine) -> Vec<String> {
    machine.reports().iter().map(|report| report.words()).collect()
}

/// The order of the manual gives 180 MHz and no report. The wait for ODRDY takes rounds of five instructions at 8 MHz
/// of HSE; the clock stands still while the regulator switches, so the one for ODSWRDY takes next to none.
#[test]
fn over_drive_gives_180_mhz_on_the_lines_that_have_it() {
    for chip in [&STM32F427VG, &STM32F429ZI, &STM32F446RE, &STM32F469NI] {
        let rounds = [45, 100].map(|over_drive_us| {
            let silicon = Silicon { over_drive_us, ..TYPICAL };
            let machine = ran_on(chip, 0, Options { silicon, ..Options::default() });
            assert_eq!(what(&machine), [""; 0], "{}", chip.chip);
            assert_eq!(machine.core_clock(), 180_000_000, "{}", chip.chip);
            let [ready, switched, csr, alias] = words(&machine, 4)[..] else { panic!() };
            assert_eq!((csr >> 16, alias), (0b11, 1), "{}", chip.chip);
            assert!(switched <= 10, "{}: {switched} rounds", chip.chip);
            ready
        });
        // HSI has 16 MHz.
        let most = [45, 100].map(|us| us * 16 / 4);
        assert!(
            rounds[0] * 2 <= rounds[1] && rounds[0] <= most[0] + 2 && rounds[1] <= most[1] + 2,
            "{rounds:?}"
        );
    }
}

/// A report names what was written: the clock that is chosen by CFGR, and the bit of PWR_CR that is not there.
#[test]
fn without_over_drive_180_mhz_are_reported_and_a_line_that_has_none_says_so() {
    let machine = ran_on(&STM32F446RE, NONE, Options::default());
    let [report] = &what(&machine)[..] else { panic!("{:?}", what(&machine)) };
    assert!(report.starts_with("write of 4 bytes at 40023808h = 9402h, pc 0800"), "{report}");
    for limit in [
        "HCLK is 180000000 Hz, the chip's limit is 168000000 without over-drive (PWR_CSR.ODSWRDY)",
        "PCLK1 is 45000000 Hz, the chip's limit is 42000000",
        "PCLK2 is 90000000 Hz, the chip's limit is 84000000",
    ] {
        assert!(report.contains(limit), "{report}");
    }
    let mut machine = ran_on(&STM32F407VG, 0, Options::default());
    let [report] = &what(&machine)[..] else { panic!("{:?}", what(&machine)) };
    assert!(report.starts_with("write of 4 bytes at 420E0040h = 1h, pc 0800"), "{report}");
    assert!(report.contains("the STM32F407 has no over-drive"), "{report}");
    assert_eq!(machine.register(0x4000_7000), Some(0x4000), "the bits are not there");
}

/// Sections 5.1.4 and 5.5.1; a supply that is too low for it makes 168 MHz the limit, too.
#[test]
fn what_comes_out_of_order_is_reported() {
    let low = Options { vdd_mv: 2_050, ..Options::default() };
    for (argument, options, wrong) in [
        (HASTY, Options::default(), &["only after ODRDY"][..]),
        (OFF_AT_SPEED, Options::default(), &["only while HSI or HSE is the system clock"]),
        (
            0,
            low,
            &[
                "no over-drive at a supply below 2.1 V",
                "no over-drive",
                "limit is 168000000 without over-drive",
            ],
        ),
    ] {
        let machine = ran_on(&STM32F429ZI, argument, options);
        let reports = what(&machine);
        assert_eq!(reports.len(), wrong.len(), "{reports:?}");
        for (report, wrong) in reports.iter().zip(wrong) {
            assert!(report.contains(wrong), "{report}");
        }
    }
}
