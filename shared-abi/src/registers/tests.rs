//! The sequences against a model of the clocks (RM0090 sections 7.3.1 to 7.3.3). The model does
//! what the application's clocks do: they take a few reads to change, and some changes are not
//! allowed before others have come into effect.

extern crate std;

use std::collections::BTreeMap;
use std::panic::{catch_unwind, AssertUnwindSafe};
use std::vec::Vec;

use super::*;

const RCC_CR: u32 = 0x4002_3800;
const RCC_PLLCFGR: u32 = 0x4002_3804;
const RCC_CFGR: u32 = 0x4002_3808;
const RCC_CIR: u32 = 0x4002_380C;
const RCC_SSCGR: u32 = 0x4002_3880;
const IWDG_KR: u32 = 0x4000_3000;
const IWDG_PR: u32 = 0x4000_3004;
const IWDG_RLR: u32 = 0x4000_3008;
const IWDG_SR: u32 = 0x4000_300C;
/// FLASH_ACR.
const ACR: u32 = 0x4002_3C00;
const HSI_ON: u32 = 0x1;
const HSI_READY: u32 = 0x2;
const PLL_ON: u32 = 0x0100_0000;
const PLL_READY: u32 = 0x0200_0000;
/// SWS: the core runs from the PLL; SW asks for it.
const FROM_PLL: u32 = 0xA;

/// A change becomes visible at this read.
const LATENCY: u32 = 3;

#[derive(Default)]
struct Chip {
    words: BTreeMap<u32, u32>,
    written: Vec<(u32, u32)>,
    /// The number of reads since the last write.
    reads: u32,
    /// No flag changes.
    is_stuck: bool,
}

impl Chip {
    fn with(words: &[(u32, u32)]) -> Self {
        Self { words: words.iter().copied().collect(), ..Self::default() }
    }

    fn word(&self, register: u32) -> u32 {
        self.words.get(&register).copied().unwrap_or_default()
    }
}

impl Registers for Chip {
    fn read(&mut self, register: u32) -> u32 {
        self.reads += 1;
        assert!(self.reads <= PATIENCE, "{register:08X} is read for ever");
        if self.reads == LATENCY && !self.is_stuck {
            self.words.insert(IWDG_SR, 0);
            let cr = self.word(RCC_CR);
            let hsi = if cr & HSI_ON == 0 { 0 } else { HSI_READY };
            let pll = if cr & PLL_ON == 0 { 0 } else { PLL_READY };
            self.words.insert(RCC_CR, cr & !HSI_READY & !PLL_READY | hsi | pll);
            let switch = self.word(RCC_CFGR) & 0b11;
            let cfgr = self.word(RCC_CFGR) & !0b1100 | switch << 2;
            self.words.insert(RCC_CFGR, cfgr);
        }
        self.word(register)
    }

    fn write(&mut self, register: u32, value: u32) {
        let (cr, cfgr) = (self.word(RCC_CR), self.word(RCC_CFGR));
        let status = match register {
            RCC_CR => {
                assert!(cfgr & 0b1100 == 0 || value & PLL_ON != 0, "the core loses its clock");
                cr & (HSI_READY | PLL_READY)
            }
            RCC_CFGR => {
                assert!(cr & HSI_READY != 0, "the core is switched to a clock that is not ready");
                cfgr & 0b1100
            }
            RCC_PLLCFGR => {
                assert_eq!(cr & PLL_READY, 0, "the PLL is changed while it runs");
                0
            }
            RCC_SSCGR => {
                assert_eq!(cr & PLL_READY, 0, "the spread is changed while the PLL runs");
                0
            }
            IWDG_KR => {
                let early = value == 0xAAAA && self.word(IWDG_SR) != 0;
                assert!(!early || self.is_stuck, "the counter takes the value before");
                0
            }
            IWDG_PR | IWDG_RLR => {
                let bit = if register == IWDG_PR { 1 } else { 2 };
                let updates = self.word(IWDG_SR);
                assert_eq!(updates & bit, 0, "the value before is still on its way");
                self.words.insert(IWDG_SR, updates | bit);
                0
            }
            _ => 0,
        };
        self.words.insert(register, value & !(if register == RCC_CR { 0x0200_0002 } else { 0 }) | status);
        self.written.push((register, value));
        self.reads = 0;
    }
}

/// The values after a reset: RM0090 sections 7.3.1 to 7.3.19, 7.3.23 and 3.9.1. Between them each bus is
/// reset; the caches are cleared while they are off. In the low-power registers all bits that exist are
/// 1 then; the others cannot be set.
const RELEASED: [(u32, u32); 27] = [
    (RCC_CFGR, 0),
    (RCC_CR, 0x0000_0083),
    (RCC_PLLCFGR, 0x2400_3010),
    (RCC_SSCGR, 0),
    (RCC_CIR, 0),
    // AHB1RSTR, AHB1ENR, AHB1LPENR, and so on for AHB2, AHB3, APB1, APB2.
    (0x4002_3810, 0xFFFF_FFFF),
    (0x4002_3810, 0),
    (0x4002_3830, 0x0010_0000),
    (0x4002_3850, 0xFFFF_FFFF),
    (0x4002_3814, 0xFFFF_FFFF),
    (0x4002_3814, 0),
    (0x4002_3834, 0),
    (0x4002_3854, 0xFFFF_FFFF),
    (0x4002_3818, 0xFFFF_FFFF),
    (0x4002_3818, 0),
    (0x4002_3838, 0),
    (0x4002_3858, 0xFFFF_FFFF),
    (0x4002_3820, 0xFFFF_FFFF),
    (0x4002_3820, 0),
    (0x4002_3840, 0),
    (0x4002_3860, 0xFFFF_FFFF),
    (0x4002_3824, 0xFFFF_FFFF),
    (0x4002_3824, 0),
    (0x4002_3844, 0),
    (0x4002_3864, 0xFFFF_FFFF),
    // ICEN and DCEN off, then ICRST and DCRST.
    (ACR, 0),
    (ACR, 0x0000_1800),
];

#[test]
fn clocks_and_peripherals_are_as_after_a_reset() {
    // The PLL runs from HSE, with HSI off and with HSI on.
    for (before, first) in [(0x0303_0080, 0x0303_0081), (0x0303_0083, 0x0303_0083)] {
        let mut chip = Chip::with(&[(RCC_CR, before), (RCC_CFGR, FROM_PLL), (ACR, 0x0705)]);
        assert!(release_peripherals(&mut chip));
        assert_eq!(chip.written[0], (RCC_CR, first));
        assert_eq!(chip.written[1..28], RELEASED);
        assert_eq!(chip.written[28..], [(ACR, 0)]);
        // HSION, HSIRDY and HSITRIM; the core runs from HSI.
        assert_eq!((chip.word(RCC_CR), chip.word(RCC_CFGR)), (0x83, 0));
    }
}

/// A chip whose clocks do not follow: there is an end, and the caller can reset.
#[test]
fn a_clock_that_does_not_follow_is_given_up() {
    for (cr, cfgr) in [(0x0303_0080, FROM_PLL), (0x0303_0083, FROM_PLL), (0x0303_0083, 0)] {
        let mut chip = Chip::with(&[(RCC_CR, cr), (RCC_CFGR, cfgr)]);
        chip.is_stuck = true;
        assert!(!release_peripherals(&mut chip), "{cr:08X}h, {cfgr:X}h");
        assert!(chip.written.iter().all(|(register, _)| *register != RCC_PLLCFGR), "{cr:08X}h, {cfgr:X}h");
    }
}

/// ARMv7-M B3.2.2, B3.3.2, B3.4.3 and B3.5.5: all interrupts disabled and not pending, priority 0,
/// faults disabled, vector table at 0, 8-byte aligned stacking (CCR.STKALIGN).
#[test]
fn the_core_is_as_after_a_reset() {
    let mut chip = Chip::default();
    release_core(&mut chip);
    // SysTick off; any write clears SYST_CVR (B3.3.5).
    let mut expected = std::vec![(0xE000_E010, 0), (0xE000_E018, 0)];
    for (clear_enable, clear_pending) in [
        (0xE000_E180, 0xE000_E280),
        (0xE000_E184, 0xE000_E284),
        (0xE000_E188, 0xE000_E288),
        (0xE000_E18C, 0xE000_E28C),
    ] {
        expected.extend([(clear_enable, 0xFFFF_FFFF), (clear_pending, 0xFFFF_FFFF)]);
    }
    // Priorities of 128 interrupts, four in a word.
    expected.extend((0xE000_E400..=0xE000_E47C).step_by(4).map(|register| (register, 0)));
    expected.extend([
        // ICSR: PENDSTCLR and PENDSVCLR.
        (0xE000_ED04, 0x0A00_0000),
        // SHPR1 to SHPR3, SHCSR, SCR, MPU_CTRL, CPACR, VTOR.
        (0xE000_ED18, 0),
        (0xE000_ED1C, 0),
        (0xE000_ED20, 0),
        (0xE000_ED24, 0),
        (0xE000_ED10, 0),
        (0xE000_ED94, 0),
        (0xE000_ED88, 0),
        (0xE000_ED08, 0),
        (0xE000_ED14, 0x0000_0200),
        // AIRCR: the key, with the priority grouping 0.
        (0xE000_ED0C, 0x05FA_0000),
    ]);
    assert_eq!(chip.written, expected);
}

/// ARMv7-M B3.2.6: VECTKEY reads FA05h; PRIGROUP stays, SYSRESETREQ is bit 2.
#[test]
fn a_reset_is_requested_with_the_key() {
    for (before, written) in
        [(0xFA05_0000, 0x05FA_0004), (0xFA05_0500, 0x05FA_0504), (0xFA05_8200, 0x05FA_0204)]
    {
        let mut chip = Chip::with(&[(0xE000_ED0C, before)]);
        request_reset(&mut chip);
        assert_eq!(chip.written, [(0xE000_ED0C, written)]);
    }
}

/// RM0090 sections 21.3 and 21.4: start; when no value is on its way, unlock prescaler and reload, 4 and 1,
/// the shortest; when they are there, load the counter. If SR never gets 0, the watchdog that runs bites.
#[test]
fn the_watchdog_runs_out_as_soon_as_it_can() {
    let stores = [(IWDG_KR, 0xCCCC), (IWDG_KR, 0x5555), (IWDG_PR, 0), (IWDG_RLR, 1), (IWDG_KR, 0xAAAA)];
    // The application has just changed its values.
    for before in [0, 0b11] {
        let mut chip = Chip::with(&[(IWDG_SR, before)]);
        start_watchdog(&mut chip);
        assert_eq!(chip.written, stores);
        assert_eq!(chip.word(IWDG_SR), 0, "AAAAh comes when the values are there");
    }
    let mut chip = Chip { is_stuck: true, ..Chip::with(&[(IWDG_SR, 1)]) };
    catch_unwind(AssertUnwindSafe(|| start_watchdog(&mut chip))).expect_err("it waits for ever");
    assert_eq!(chip.written, stores[..1]);
}

/// ARMv7-M B1.4.2: bits 0 to 8 of IPSR are the exception number.
#[test]
fn an_exception_is_active_if_ipsr_has_a_number() {
    assert!(!in_handler(0) && !in_handler(0xFFFF_FE00));
    assert!(in_handler(3) && in_handler(0x100) && in_handler(0x1FF));
}
