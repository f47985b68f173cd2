//! RTC, LSE and the backup domain (RM0090 sections 7.1.3, 7.2.8 and 26).

use super::*;

const RTC_TR: u32 = 0x4000_2800;
const RTC_DR: u32 = 0x4000_2804;
const RTC_BKP0R: u32 = 0x4000_2850;
const RCC_BDCR: u32 = 0x4002_3870;

/// [`programs::RTC`] from power-on to this time in ms.
fn ran_until(until_ms: u64, silicon: Silicon) -> Machine {
    let mut machine = with_options(&programs::RTC, Options { silicon, ..Options::default() });
    put(&mut machine, ARGUMENT, 0);
    assert_eq!(machine.run_until(ms(until_ms)), Stop::Deadline);
    machine
}

/// The set-up waits for LSE, as long as this crystal takes, and for 1 to 2 and 4 to 6 periods of RTCCLK; and the time
/// goes on over resets, without a program's help, until the supply goes.
#[test]
fn the_set_up_of_st_s_hal_ends_and_the_calendar_outlives_resets() {
    for lse_start_ms in [600, 2_000] {
        let mut machine = ran_until(u64::from(lse_start_ms) + 1, Silicon { lse_start_ms, ..TYPICAL });
        let [_, lse, init, copied, tr, dr] = words(&machine, 6)[..] else { panic!() };
        // Rounds of four instructions at 16 MHz.
        assert!(lse.abs_diff(lse_start_ms * 4_000) < 100, "{lse}");
        // 30.5 µs are 122 rounds.
        assert!((118..248).contains(&init) && (480..740).contains(&copied), "{init}, {copied}");
        assert_eq!((tr, dr), (0x0023_5950, 0x0024_6228));
        let start = u64::from(lse_start_ms);
        machine.reset_pin();
        machine.run_until(ms(start + 20_500));
        assert_eq!(words(&machine, 3)[1..], [0, 0], "it was done before");
        let registers = [RTC_TR, RTC_DR, RTC_BKP0R, RCC_BDCR].map(|at| machine.register(at).unwrap());
        assert_eq!(registers, [0x10, 0x0024_8229, 0x32F2, 0x8103]);
        assert_eq!(machine.reports(), []);
        machine.power_off();
        machine.power_on(ms(60_000));
        put(&mut machine, ARGUMENT, 0);
        let registers = [RTC_TR, RTC_DR, RTC_BKP0R, RCC_BDCR].map(|at| machine.register(at).unwrap());
        assert_eq!(registers, [0, 0x2101, 0, 0]);
        machine.run_until(ms(60_000 + start + 1));
        assert_eq!(words(&machine, 6)[4..], [0x0023_5950, 0x0024_6228], "set up again");
    }
}

/// Section 7.3.20: without DBP the backup domain takes no write. Each is reported with its value.
#[test]
fn the_backup_domain_is_closed_without_dbp() {
    let mut machine = with_options(&programs::RTC, Options::default());
    put(&mut machine, ARGUMENT, 1);
    machine.run_until(ms(2_500));
    assert_eq!(machine.register(RCC_BDCR), Some(0), "and the program waits for LSERDY for ever");
    let [report] = machine.reports() else { panic!("{:?}", machine.reports()) };
    let words = report.words();
    assert!(words.starts_with("write of 4 bytes at 40023870h = 1h, pc 0800"), "{words}");
    assert!(words.contains("PWR_CR.DBP"), "{words}");
}

/// BDRST takes all of it, which no system reset does; RTCSEL is chosen once (section 7.2.8).
#[test]
fn a_backup_domain_reset_takes_clock_calendar_and_registers() {
    let mut machine = ran_until(2_010, TYPICAL);
    let write = |machine: &mut Machine, value: u32| {
        machine.poke(RCC_BDCR, &value.to_le_bytes()).unwrap();
        [RCC_BDCR, RTC_DR, RTC_BKP0R].map(|at| machine.register(at).unwrap())
    };
    assert_eq!(write(&mut machine, 0x8201), [0x8103, 0x0024_6228, 0x32F2], "LSI");
    assert_eq!(write(&mut machine, 1 << 16), [1 << 16, 0x2101, 0]);
    assert_eq!(write(&mut machine, 0x8200), [0x8200, 0x2101, 0]);
}
