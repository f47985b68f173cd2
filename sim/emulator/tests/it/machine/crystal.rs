//! A crystal that stops while the system clock comes from it (RM0090 section 7.2.7).

use super::*;

const RCC_CR: u32 = 0x4002_3800;
const RCC_PLLCFGR: u32 = 0x4002_3804;
const RCC_CFGR: u32 = 0x4002_3808;
const RCC_CIR: u32 = 0x4002_380C;
/// ICSR: the exception that is active, and NMIPENDSET.
const ICSR: u32 = 0xE000_ED04;
const CSSON: u32 = 1 << 19;
const CSSF: u32 = 1 << 7;
const CSSC: u32 = 1 << 23;

fn write(machine: &mut Machine, register: u32, value: u32) {
    machine.poke(register, &value.to_le_bytes()).unwrap();
    machine.run_until(machine.now() + Span::from_millis(10));
}

/// A core at 64 MHz from a crystal of 8 MHz by the PLL: x 16 / 2.
fn by_the_pll(security: u32, silicon: Silicon) -> Machine {
    let mut machine = with_options(&programs::BUSY, Options { silicon, ..Options::default() });
    machine.run_until(ms(1));
    write(&mut machine, RCC_PLLCFGR, 8 | 128 << 6 | 1 << 22);
    write(&mut machine, RCC_CR, 0x0101_0083 | security);
    machine.poke(0x4002_3C00, &2_u32.to_le_bytes()).unwrap();
    write(&mut machine, RCC_CFGR, 0b100 << 10 | 2);
    assert_eq!(machine.core_clock(), 64_000_000);
    machine
}

/// Boards report a core that goes on at a few MHz: the PLL runs at its lowest frequency. It is back with its crystal.
#[test]
fn without_the_security_system_a_pll_goes_on_at_its_lowest_frequency() {
    for pll_free_hz in [5_000_000, 16_000_000] {
        let mut machine = by_the_pll(0, Silicon { pll_free_hz, ..TYPICAL });
        machine.set_crystal(0);
        machine.run_until(machine.now() + Span::from_millis(10));
        assert_eq!(machine.core_clock(), pll_free_hz / 2);
        // HSEON is software's; HSERDY has gone.
        assert_eq!(machine.register(RCC_CR).unwrap() & 0b11 << 16, 1 << 16);
        machine.set_crystal(8_000_000);
        machine.run_until(machine.now() + Span::from_millis(10));
        assert_eq!(machine.core_clock(), 64_000_000);
    }
}

/// The core goes on from HSI; crystal and PLL are off, and the NMI comes until CSSC is written.
#[test]
fn with_the_security_system_hsi_takes_its_place_and_the_nmi_comes() {
    let mut machine = by_the_pll(CSSON, TYPICAL);
    assert_eq!(machine.register(RCC_CIR).unwrap() & CSSF, 0);
    machine.set_crystal(0);
    // The program has no handler for it: the core locks up there.
    machine.run_until(machine.now() + Span::from_millis(1));
    assert_eq!(machine.core_clock(), 16_000_000);
    assert_eq!(machine.register(RCC_CR).unwrap() & 0x0303_0000, 0, "crystal and PLL are off");
    assert_eq!(machine.register(RCC_CFGR).unwrap() & 0b1111, 0, "HSI");
    assert_eq!(machine.register(RCC_CIR).unwrap() & CSSF, CSSF);
    assert_eq!(machine.register(ICSR).unwrap() & 0x1FF, 2, "the NMI is active");
    assert_ne!(machine.register(ICSR).unwrap() & 1 << 31, 0, "and comes again");
    machine.poke(RCC_CIR, &CSSC.to_le_bytes()).unwrap();
    assert_eq!(machine.register(RCC_CIR).unwrap() & CSSF, 0);
}

/// A crystal that is the system clock itself, without a PLL and without the security system: the core stands still
/// until the independent watchdog, which has the LSI, resets it: 4 x 1001 periods of 32 kHz.
#[test]
fn a_core_that_runs_from_the_crystal_itself_stands_still_until_the_watchdog_bites() {
    let mut machine = machine(&programs::BUSY);
    machine.run_until(ms(1));
    machine.poke(RCC_CR, &0x0001_0083_u32.to_le_bytes()).unwrap();
    machine.run_until(ms(10));
    machine.poke(RCC_CFGR, &1_u32.to_le_bytes()).unwrap();
    machine.run_until(ms(11));
    assert_eq!(machine.core_clock(), 8_000_000);
    machine.preset_watchdog(1_000);
    machine.set_crystal(0);
    let before = machine.counters().instructions;
    assert_eq!(machine.run_until(ms(111)), Stop::Deadline);
    assert!(machine.counters().instructions - before < 10);
    assert_eq!(machine.run_until(ms(500)), Stop::Reset(ResetCause::IndependentWatchdog));
    let at = machine.now().0 / 1_000_000;
    assert!((136_120..136_130).contains(&at), "{at} us");
    machine.run_until(ms(200));
    assert_eq!(machine.core_clock(), 16_000_000);
    assert!(machine.counters().instructions > before + 1_000);
}
