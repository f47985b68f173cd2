use super::*;
use crate::time::Span;

const LSE: u64 = 32_768;

/// The time of an edge of 32 768 Hz, rounded up.
fn edge(n: u64) -> Time {
    Time(crate::clock::picos_of(n, LSE))
}

fn seconds(n: u64) -> Time {
    Time(0) + Span::from_millis(1_000 * n)
}

/// With a clock of 32 768 Hz and the keys given.
fn open() -> Rtc {
    let mut rtc = Rtc::default();
    rtc.follow(Some((32_768, Time(0))), Time(0));
    rtc.write(WPR, 0xCA, Time(0)).unwrap();
    rtc.write(WPR, 0x53, Time(0)).unwrap();
    rtc
}

fn read(rtc: &mut Rtc, offset: u32, now: Time) -> u32 {
    rtc.read(offset, now).unwrap()
}

/// Sets time and date, from edge 0 to edge 4.
fn set_to(rtc: &mut Rtc, cr: u32, tr: u32, dr: u32) {
    rtc.write(ISR, ISR_INIT | ISR_RSF, Time(0)).unwrap();
    rtc.write(CR, cr, edge(2)).unwrap();
    rtc.write(TR, tr, edge(2)).unwrap();
    rtc.write(DR, dr, edge(2)).unwrap();
    rtc.write(ISR, 0, edge(2)).unwrap();
}

/// Sections 26.6.1 to 26.6.11: the values after a backup domain reset.
#[test]
fn reset_values_are_those_of_the_manual() {
    let mut rtc = Rtc::default();
    for (offset, value) in
        [(TR, 0), (DR, 0x2101), (CR, 0), (ISR, 7), (PRER, 0x007F_00FF), (WUTR, 0xFFFF), (WPR, 0)]
    {
        assert_eq!(read(&mut rtc, offset, Time(0)), value, "offset {offset:02X}h");
    }
    assert!(rtc.read(0xA0, Time(0)).is_err() && rtc.write(0xA0, 0, Time(0)).is_err());
}

/// Section 26.3.5: CAh, then 53h; a wrong key closes; a system reset does not. TAFCR and the backup registers need
/// no key.
#[test]
fn the_keys_open_the_registers_until_a_wrong_one() {
    for (keys, is_open) in [
        (&[0xCA, 0x53][..], true),
        (&[0xCA, 0xCA, 0x53], true),
        (&[0xCA, 0x53, 0xFF], false),
        (&[0x53, 0xCA], false),
        (&[0xCA, 0xFF, 0x53], false),
        (&[], false),
    ] {
        let mut rtc = Rtc::default();
        for key in keys {
            rtc.write(WPR, *key, Time(0)).unwrap();
        }
        rtc.reset();
        assert_eq!(rtc.write(WUTR, 5, Time(0)).is_ok(), is_open, "{keys:X?}");
        assert_eq!(read(&mut rtc, WUTR, Time(0)), if is_open { 5 } else { 0xFFFF }, "{keys:X?}");
        rtc.write(BACKUP.0, 6, Time(0)).unwrap();
        rtc.write(TAFCR, 1 << 18, Time(0)).unwrap();
        assert_eq!([BACKUP.0, TAFCR].map(|at| read(&mut rtc, at, Time(0))), [6, 1 << 18]);
    }
}

/// Section 26.3.5: INITF 1 to 2 periods after INIT, and time, date and prescalers only then; the count goes on 4
/// periods after INIT is cleared. Section 26.3.6: RSF with the next copy, every two periods.
#[test]
fn the_calendar_is_set_in_initialization_mode() {
    let mut rtc = open();
    rtc.write(ISR, ISR_INIT | ISR_RSF, Time(1)).unwrap();
    for (offset, value) in [(TR, 0x0012_3456), (DR, 0x0024_6229), (PRER, 0x00FF)] {
        assert!(rtc.write(offset, value, edge(1)).is_err(), "offset {offset:02X}h");
    }
    assert_eq!(read(&mut rtc, ISR, edge(1)) & 0xFF, ISR_INIT | 7);
    assert_eq!(
        read(&mut rtc, ISR, edge(2)) & 0xFF,
        ISR_INIT | ISR_INITF | ISR_WUTWF,
        "no alarm may be written"
    );
    // In two steps, and to the same values.
    rtc.write(PRER, 0x00FF, edge(2)).unwrap();
    rtc.write(PRER, 0x007F_00FF, edge(2)).unwrap();
    rtc.write(TR, 0x0012_3456, edge(2)).unwrap();
    rtc.write(DR, 0x0024_6229, edge(2)).unwrap();
    // It stands still, however long this takes.
    assert_eq!(read(&mut rtc, TR, seconds(9)), 0x0012_3456);
    let start = 9 * LSE;
    rtc.write(ISR, 0, seconds(9)).unwrap();
    assert_eq!(read(&mut rtc, ISR, edge(start + 3)) & 0xF0, ISR_INITS);
    assert_eq!(read(&mut rtc, ISR, edge(start + 4)) & 0xF7, ISR_INITS | ISR_RSF | 7);
    for (at, tr, ssr) in [
        (start + 4, 0x0012_3456, 0xFF),
        (start + 4 + 128, 0x0012_3456, 0xFE),
        (start + 4 + LSE - 2, 0x0012_3456, 0),
        (start + 4 + LSE, 0x0012_3457, 0xFF),
        (start + 4 + 4 * LSE, 0x0012_3500, 0xFF),
    ] {
        assert_eq!([SSR, TR, DR].map(|it| read(&mut rtc, it, edge(at))), [ssr, tr, 0x0024_6229], "{at}");
    }
    // RSF is software's to clear, not to set.
    rtc.write(ISR, 0, edge(start + 5)).unwrap();
    assert_eq!([5, 6].map(|n| read(&mut rtc, ISR, edge(start + n)) & ISR_RSF), [0, ISR_RSF]);
    // Nothing that is no time, or no date.
    rtc.write(ISR, ISR_INIT, edge(start + 10)).unwrap();
    for (offset, value) in
        [(TR, 0x0024_0000), (TR, 0x6000), (TR, 0x0A), (DR, 0x0024_0229), (DR, 0x2000), (DR, 0x2100)]
    {
        assert!(rtc.write(offset, value, edge(start + 12)).is_err(), "{value:X}h");
    }
}

/// Months by the calendar; 24:00 in both formats; the day of the week is counted on its own.
#[test]
fn days_months_and_years_pass() {
    const FMT: u32 = CR_FMT;
    for (cr, before, after, (tr, dr)) in [
        // Wednesday, 28 February 2024, and the same without a leap year.
        (0, (0x0023_5959, 0x0024_6228), 1, (0, 0x0024_8229)),
        (0, (0x0023_5959, 0x0023_4228), 1, (0, 0x0023_6301)),
        (0, (0x0023_5959, 0x0024_E430), 1, (0, 0x0024_2501)),
        (0, (0x0023_5959, 0x0099_9231), 1, (0, 0x0000_A101)),
        // 200 days and 3 hours from 1 January 2024, a Monday.
        (0, (0, 0x0024_2101), 200 * 86_400 + 10_800, (0x0003_0000, 0x0024_A719)),
        (FMT, (0x0051_5959, 0x0024_2101), 1, (0x0012_0000, 0x0024_4102)),
        (FMT, (0x0011_5959, 0x0024_2101), 1, (0x0052_0000, 0x0024_2101)),
        (FMT, (0x0052_0000, 0x0024_2101), 3_600, (0x0041_0000, 0x0024_2101)),
    ] {
        let mut rtc = open();
        set_to(&mut rtc, cr, before.0, before.1);
        assert_eq!([TR, DR].map(|it| read(&mut rtc, it, edge(6))), [before.0, before.1]);
        let now = edge(6 + after * LSE);
        assert_eq!([TR, DR].map(|it| read(&mut rtc, it, now)), [tr, dr], "{before:X?}");
    }
}

/// Section 26.3.6: SSR locks TR and DR, TR locks DR, until DR is read; not with BYPSHAD, which has no RSF either.
#[test]
fn a_load_locks_what_is_above_it() {
    let mut rtc = open();
    set_to(&mut rtc, 0, 0x0023_5959, 0x0024_6228);
    read(&mut rtc, SSR, edge(6));
    assert_eq!(read(&mut rtc, TR, edge(6 + 3 * LSE)), 0x0023_5959, "of the moment of SSR");
    assert_eq!(read(&mut rtc, DR, edge(6 + 3 * LSE)), 0x0024_6228);
    assert_eq!([TR, DR].map(|it| read(&mut rtc, it, edge(6 + 3 * LSE))), [2, 0x0024_8229]);
    let mut rtc = open();
    set_to(&mut rtc, CR_BYPSHAD, 0x0023_5959, 0x0024_6228);
    read(&mut rtc, SSR, edge(6));
    assert_eq!([TR, DR].map(|it| read(&mut rtc, it, edge(6 + 3 * LSE))), [2, 0x0024_8229]);
    assert_eq!(read(&mut rtc, ISR, edge(6 + 3 * LSE)) & ISR_RSF, 0);
}

/// Section 26.3.7: a system reset takes the shadow registers, INIT, INITF and RSF; the calendar goes on.
#[test]
fn a_system_reset_leaves_the_calendar_alone() {
    let mut rtc = open();
    set_to(&mut rtc, 0, 0x0010_0000, 0x0024_6228);
    rtc.write(BACKUP.1, 0x1234_5678, edge(9)).unwrap();
    rtc.reset();
    rtc.follow(Some((32_768, Time(0))), seconds(30));
    assert_eq!(read(&mut rtc, ISR, seconds(30)) & 0xE0, 0);
    assert_eq!([TR, DR].map(|it| read(&mut rtc, it, seconds(30))), [0, 0x2101], "not yet copied");
    let copied = edge(30 * LSE + 2);
    assert_eq!(read(&mut rtc, ISR, copied) & 0xF0, ISR_INITS | ISR_RSF);
    assert_eq!([TR, DR].map(|it| read(&mut rtc, it, copied)), [0x0010_0029, 0x0024_6228]);
    assert_eq!(read(&mut rtc, BACKUP.1, copied), 0x1234_5678);
    // In initialization mode, it goes on from where it was set.
    rtc.write(ISR, ISR_INIT, seconds(40)).unwrap();
    rtc.write(TR, 0, seconds(41)).unwrap();
    rtc.reset();
    rtc.follow(Some((32_768, Time(0))), seconds(50));
    assert_eq!([50, 61].map(|n| read(&mut rtc, ISR, seconds(n)) & (ISR_INIT | ISR_INITF)), [0, 0]);
    assert_eq!(read(&mut rtc, TR, seconds(61)), 0x10);
}

/// Without RTCCLK the initialization mode is never entered, and nothing counts; time goes on from a clock's first edge.
#[test]
fn a_clock_that_starts_and_stops_is_followed() {
    let mut rtc = open();
    rtc.follow(None, Time(0));
    rtc.write(ISR, ISR_INIT, Time(0)).unwrap();
    assert_eq!(read(&mut rtc, ISR, seconds(1_000)) & ISR_INITF, 0);
    rtc.follow(Some((32_768, seconds(1_002))), seconds(1_000));
    assert_eq!(read(&mut rtc, ISR, seconds(1_002)) & ISR_INITF, 0);
    assert_eq!(read(&mut rtc, ISR, seconds(1_003)) & ISR_INITF, ISR_INITF);
    rtc.write(ISR, 0, seconds(1_003)).unwrap();
    rtc.follow(None, seconds(1_013));
    rtc.follow(Some((32_768, seconds(2_000))), seconds(2_000));
    rtc.follow(None, seconds(2_005));
    let tr = read(&mut rtc, TR, seconds(3_000));
    assert_eq!(tr, 0x14, "10 s and 5 s, less the 4 edges before the first");
}

/// Section 26.6.4 and 26.3.5: the flags follow RTC_CR after 2 periods. Whatever has no model says so.
#[test]
fn write_flags_follow_and_what_is_not_modelled_is_named() {
    let mut rtc = open();
    for (enable, flag) in [(CR_ALRAE, ISR_ALRAWF), (CR_ALRBE, ISR_ALRBWF), (CR_WUTE, ISR_WUTWF)] {
        let mut rtc = rtc.clone();
        assert!(rtc.write(CR, enable, Time(0)).is_err());
        assert_eq!([1, 2].map(|n| read(&mut rtc, ISR, edge(n)) & 7), [7, 7 & !flag], "{enable:X}h");
        rtc.write(CR, 0, edge(10)).unwrap();
        assert_eq!([11, 12].map(|n| read(&mut rtc, ISR, edge(n)) & 7), [7 & !flag, 7], "{enable:X}h");
    }
    let now = Time(0);
    for (offset, value) in
        [(CR, 1 << 16), (CR, 1 << 21), (CR, CR_FMT), (CALR, 1), (SHIFTR, 1), (TAFCR, 1), (SSR, 1), (0x4C, 1)]
    {
        assert!(rtc.write(offset, value, now).is_err(), "offset {offset:02X}h");
    }
    assert_eq!(read(&mut rtc, CR, now) & (CR_FMT | CR_HOUR), 0, "not in this mode; never read");
    rtc.write(CR, 1 << 18, now).unwrap();
    assert_eq!(read(&mut rtc, CR, now), 1 << 18, "BKP");
}
