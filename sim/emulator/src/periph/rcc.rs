//! Reset and clock control (RM0090 sections 6 and 7, RM0390 section 6).

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::silicon::Silicon;
use crate::time::{Span, Time};
use crate::variant::{Plain, Variant};

// Start-up times, typical, from the datasheet (DocID022152 rev 8, section 5.3.8 to 5.3.10).
const HSI_START: Span = Span(2_200_000);
const LSI_START: Span = Span::from_micros(15);
/// The maximum at the upper end of the VCO range.
const PLL_LOCK: Span = Span::from_micros(200);

/// CFGR: the source of the system clock that software wants.
const CFGR_SW: u32 = 0b11;

const CR_HSION: u32 = 1 << 0;
const CR_HSIRDY: u32 = 1 << 1;
const CR_HSEON: u32 = 1 << 16;
const CR_HSERDY: u32 = 1 << 17;
const CR_HSEBYP: u32 = 1 << 18;
const CR_CSSON: u32 = 1 << 19;
const CR_PLLON: u32 = 1 << 24;
const CR_PLLRDY: u32 = 1 << 25;
const CR_PLLI2SON: u32 = 1 << 26;
const CR_PLLI2SRDY: u32 = 1 << 27;
const CR_PLLSAION: u32 = 1 << 28;
const CR_TRIM: u32 = 0x1F << 3;
const CR_RESET: u32 = 0x0000_0083;

/// CIR: the clock security system has seen the crystal fail, and the bit that takes this away.
const CIR_CSSF: u32 = 1 << 7;
const CIR_CSSC: u32 = 1 << 23;

const CSR_LSION: u32 = 1 << 0;
const CSR_LSIRDY: u32 = 1 << 1;
const CSR_RMVF: u32 = 1 << 24;
const CSR_BORRSTF: u32 = 1 << 25;
const CSR_PINRSTF: u32 = 1 << 26;
const CSR_PORRSTF: u32 = 1 << 27;
const CSR_SFTRSTF: u32 = 1 << 28;
const CSR_IWDGRSTF: u32 = 1 << 29;
const CSR_WWDGRSTF: u32 = 1 << 30;
const CSR_LPWRRSTF: u32 = 1 << 31;

const BDCR_LSEON: u32 = 1 << 0;
const BDCR_LSERDY: u32 = 1 << 1;
/// The choice of the clock of RTC, and its gate.
const BDCR_RTCSEL: u32 = 0b11 << 8;
const BDCR_RTCEN: u32 = 1 << 15;
const BDCR_BDRST: u32 = 1 << 16;

/// Why the chip came out of reset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetCause {
    /// Power came up.
    PowerOn,
    /// NRST was pulled low.
    Pin,
    /// AIRCR.SYSRESETREQ.
    Software,
    /// The independent watchdog ran out.
    IndependentWatchdog,
    /// The window watchdog ran out, or was refreshed outside its window.
    WindowWatchdog,
    /// The program entered Stop or Standby, for which the option bits nRST_STOP and nRST_STDBY have a
    /// reset.
    LowPower,
    /// A wake-up from Standby, which starts the chip as a reset does.
    Standby,
    /// The supply is back after it was below the brown-out level of the option bytes.
    BrownOut,
}

/// The frequencies that the program has set up, in Hz.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Clocks {
    /// The CPU, the AHB, SysTick.
    pub hclk: u32,
    /// APB1: CAN among others.
    pub pclk1: u32,
    /// APB2.
    pub pclk2: u32,
    /// The timers at APB1.
    pub timclk1: u32,
    /// The timers at APB2.
    pub timclk2: u32,
}

/// An oscillator or PLL: off, or on and ready at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Source {
    Off,
    On { ready: Time },
}

impl Source {
    fn switch(&mut self, on: bool, start: Span, now: Time) {
        match (on, *self) {
            (true, Source::Off) => *self = Source::On { ready: now + start },
            (false, Source::On { .. }) => *self = Source::Off,
            _ => {}
        }
    }

    fn is_on(self) -> bool {
        self != Source::Off
    }

    fn is_ready(self, now: Time) -> bool {
        matches!(self, Source::On { ready } if ready <= now)
    }

    /// Its two bits in a register.
    fn bits(self, on: u32, ready: u32, now: Time) -> u32 {
        (if self.is_on() { on } else { 0 }) | (if self.is_ready(now) { ready } else { 0 })
    }

    fn next_event(self, now: Time) -> Option<Time> {
        match self {
            Source::On { ready } if ready > now => Some(ready),
            _ => None,
        }
    }
}

const PLLCFGR: u32 = 0x04;
const SSCGR: u32 = 0x80;
/// Offset of RCC_AHB1ENR.
pub const AHB1ENR: u32 = 0x30;
/// Offset of RCC_AHB2ENR.
pub const AHB2ENR: u32 = 0x34;
/// Offset of RCC_DCKCFGR, on the chips that have it.
const DCKCFGR: u32 = 0x8C;
const DCKCFGR_TIMPRE: u32 = 1 << 24;
/// Offset of RCC_BDCR.
pub const BDCR: u32 = 0x70;
/// Offset of RCC_APB1ENR.
pub const APB1ENR: u32 = 0x40;
/// Offset of RCC_APB2ENR.
pub const APB2ENR: u32 = 0x44;

/// The clock tree and the reset flags.
#[derive(Clone, Debug)]
pub struct Rcc {
    /// Frequency of the crystal or clock at OSC_IN; 0 where there is none, or it has stopped.
    hse_hz: u32,
    /// Whether the clock security system has seen the crystal fail: CIR.CSSF.
    has_failed: bool,
    variant: &'static Variant,
    silicon: Silicon,
    /// The variant's plain registers.
    plain: Vec<Plain>,
    hsi: Source,
    hse: Source,
    pll: Source,
    plli2s: Source,
    lsi: Source,
    lse: Source,
    cr_rest: u32,
    cfgr: u32,
    /// The source that feeds the system clock, as SWS shows it.
    sws: u32,
    csr_flags: u32,
    bdcr_rest: u32,
    now: Time,
}

impl Rcc {
    /// As after power-on, on this chip, with a crystal of `hse_hz`; 0 means that there is none.
    #[must_use]
    pub fn new(variant: &'static Variant, hse_hz: u32, silicon: Silicon) -> Self {
        Self {
            hse_hz,
            has_failed: false,
            variant,
            silicon,
            plain: variant.rcc().collect(),
            hsi: Source::On { ready: Time(0) },
            hse: Source::Off,
            pll: Source::Off,
            plli2s: Source::Off,
            lsi: Source::Off,
            lse: Source::Off,
            cr_rest: CR_RESET & CR_TRIM,
            cfgr: 0,
            sws: 0,
            csr_flags: CSR_PORRSTF | CSR_PINRSTF | CSR_BORRSTF,
            bdcr_rest: 0,
            now: Time(0),
        }
    }

    /// Adds the flags of a reset. Every internal reset pulls NRST low too, so the pin's flag comes
    /// with it (section 7.1.1); a wake-up from Standby is no such reset.
    pub fn note_reset(&mut self, cause: ResetCause) {
        const POWER_ON: u32 = CSR_PORRSTF | CSR_BORRSTF | CSR_PINRSTF;
        self.csr_flags |= match cause {
            ResetCause::PowerOn => POWER_ON,
            ResetCause::Pin => CSR_PINRSTF,
            ResetCause::Software => CSR_SFTRSTF | CSR_PINRSTF,
            ResetCause::IndependentWatchdog => CSR_IWDGRSTF | CSR_PINRSTF,
            ResetCause::WindowWatchdog => CSR_WWDGRSTF | CSR_PINRSTF,
            ResetCause::LowPower => CSR_LPWRRSTF | CSR_PINRSTF,
            ResetCause::Standby if self.silicon.flags_after_standby => POWER_ON,
            ResetCause::Standby => 0,
            ResetCause::BrownOut => CSR_BORRSTF | CSR_PINRSTF,
        };
    }

    /// The crystal has this frequency from now on; 0 when it stops. The clock security system puts the HSI in its
    /// place, and switches off what ran from it (section 7.2.7). Without it a PLL goes on at its lowest frequency.
    pub fn set_crystal(&mut self, hz: u32, now: Time) {
        let fails = hz == 0 && self.hse_is_ready(now) && self.cr_rest & CR_CSSON != 0;
        self.hse_hz = hz;
        if !fails {
            return;
        }
        self.has_failed = true;
        self.hse = Source::Off;
        if self.hse_feeds_sysclk() {
            if self.sws == 2 {
                (self.pll, self.plli2s) = (Source::Off, Source::Off);
            }
            self.hsi.switch(true, Span(0), now);
            self.cfgr &= !CFGR_SW;
            self.sws = 0;
        }
    }

    /// Whether the clock security system has seen the crystal fail. It asks for the NMI until software has
    /// cleared its flag (section 7.2.7).
    #[must_use]
    pub fn has_failed(&self) -> bool {
        self.has_failed
    }

    fn hse_is_ready(&self, now: Time) -> bool {
        self.hse_hz > 0 && self.hse.is_ready(now)
    }

    fn pll_from_hse(&self) -> bool {
        self.plain(PLLCFGR) & 1 << 22 != 0
    }

    /// Whether the system clock comes from the crystal, or from a PLL that does.
    fn hse_feeds_sysclk(&self) -> bool {
        self.sws == 1 || self.sws == 2 && self.pll_from_hse()
    }

    /// Whether the system clock is that of a crystal that has stopped, without a PLL.
    #[must_use]
    pub fn is_stopped(&self) -> bool {
        self.hse_hz == 0 && self.sws == 1
    }

    /// Whether the PLL is on, and whether the system clock comes from it.
    #[must_use]
    pub fn pll_use(&self) -> (bool, bool) {
        (self.pll.is_on(), self.sws == 2)
    }

    /// CFGR as software has written it.
    #[must_use]
    pub fn cfgr(&self) -> u32 {
        self.cfgr
    }

    /// Whether the LSI is on.
    #[must_use]
    pub fn lsi_is_on(&self) -> bool {
        self.lsi.is_on()
    }

    /// The clock of RTC: its frequency in Hz, and the time from which on it is there (section 7.2.8).
    #[must_use]
    pub fn rtc_clock(&self) -> Option<(u32, Time)> {
        let divider = self.cfgr >> 16 & 0x1F;
        let (source, hz) = match (self.bdcr_rest & BDCR_RTCSEL) >> 8 {
            1 => (self.lse, 32_768),
            2 => (self.lsi, self.silicon.lsi_hz),
            // RTCPRE: 0 and 1 are no clock.
            3 => (self.hse, if divider > 1 { self.hse_hz / divider } else { 0 }),
            _ => return None,
        };
        match source {
            Source::On { ready } if hz > 0 && self.bdcr_rest & BDCR_RTCEN != 0 => Some((hz, ready)),
            _ => None,
        }
    }

    /// BDCR.BDRST: whether the backup domain is held in reset.
    #[must_use]
    pub fn resets_backup_domain(&self) -> bool {
        self.bdcr_rest & BDCR_BDRST != 0
    }

    /// The watchdog forces the LSI on (section 21.3).
    pub fn force_lsi(&mut self, now: Time) {
        self.lsi.switch(true, LSI_START, now);
    }

    /// A register that is kept as written; 0 for any other.
    #[must_use]
    pub fn plain(&self, offset: u32) -> u32 {
        self.plain.iter().find(|register| register.at == offset).map_or(0, |register| register.value)
    }

    fn unknown(&self) -> Unmodelled {
        Unmodelled(format!("RCC has no such register on the {}, or it is not modelled", self.variant.name))
    }

    fn pll_hz(&self) -> u32 {
        let cfgr = self.plain(PLLCFGR);
        let input = if self.pll_from_hse() { self.hse_hz } else { self.silicon.hsi_hz };
        let (m, n) = (cfgr & 0x3F, cfgr >> 6 & 0x1FF);
        let p = 2 * ((cfgr >> 16 & 3) + 1);
        let vco = match input {
            0 => self.silicon.pll_free_hz.into(),
            _ => u64::from(input) * u64::from(n) / u64::from(m.max(1)),
        };
        let vco = vco.saturating_sub(vco * self.down_spread() / (2 * u64::from(n.max(1)) * 0x7FFF));
        u32::try_from(vco / u64::from(p)).unwrap_or(u32::MAX)
    }

    /// By SSCGR in down-spread mode, the depth of the modulation, in parts of PLLN × (2^15 - 1) (section
    /// 7.3.23). The mean frequency is half of it lower; centre-spread mode leaves the mean as it is.
    fn down_spread(&self) -> u64 {
        const SSCGEN_AND_SPREADSEL: u32 = 0b11 << 30;
        let value = self.plain(SSCGR);
        let (period, step) = (u64::from(value & 0x1FFF), u64::from(value >> 13 & 0x7FFF));
        if value & SSCGEN_AND_SPREADSEL == SSCGEN_AND_SPREADSEL {
            5 * (period * step).min(0x7FFF)
        } else {
            0
        }
    }

    /// What the program has set up.
    #[must_use]
    pub fn clocks(&self) -> Clocks {
        let sysclk = match self.sws {
            0 => self.silicon.hsi_hz,
            1 => self.hse_hz,
            _ => self.pll_hz(),
        };
        let ahb_shift = match self.cfgr >> 4 & 0xF {
            field @ 8..=11 => field - 7,
            field @ 12..=15 => field - 6,
            _ => 0,
        };
        let apb_shift = |field: u32| if field & 4 != 0 { (field & 3) + 1 } else { 0 };
        let hclk = (sysclk >> ahb_shift).max(1);
        let (apb1, apb2) = (apb_shift(self.cfgr >> 10 & 7), apb_shift(self.cfgr >> 13 & 7));
        // A timer gets twice the clock of its bus, but not more than HCLK; four times it with TIMPRE
        // (sections 6.2 and 6.3.25).
        let doubled = if self.plain(DCKCFGR) & DCKCFGR_TIMPRE != 0 { 2 } else { 1 };
        let divided = |shift: u32| (hclk >> shift).max(1);
        Clocks {
            hclk,
            pclk1: divided(apb1),
            pclk2: divided(apb2),
            timclk1: divided(apb1.saturating_sub(doubled)),
            timclk2: divided(apb2.saturating_sub(doubled)),
        }
    }

    /// Takes the source that SW asks for as soon as it is ready (section 7.2.6).
    fn follow_sw(&mut self, now: Time) {
        let wanted = self.cfgr & 3;
        let ready = match wanted {
            0 => self.hsi.is_ready(now),
            1 => self.hse_is_ready(now),
            2 => self.pll.is_ready(now),
            _ => false,
        };
        if ready {
            self.sws = wanted;
        }
    }

    fn cr(&self, now: Time) -> u32 {
        let hse_ready = if self.hse_hz > 0 { CR_HSERDY } else { 0 };
        self.cr_rest
            | self.hsi.bits(CR_HSION, CR_HSIRDY, now)
            | self.hse.bits(CR_HSEON, hse_ready, now)
            | self.pll.bits(CR_PLLON, CR_PLLRDY, now)
            | self.plli2s.bits(CR_PLLI2SON, CR_PLLI2SRDY, now)
    }

    fn write_cr(&mut self, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.cr_rest = value & (CR_TRIM | CR_HSEBYP | CR_CSSON);
        // What feeds the system clock cannot be switched off (section 7.3.1).
        let (hse_fed, pll_fed) = (self.hse_feeds_sysclk(), self.sws == 2);
        let hsi_fed = !hse_fed;
        self.hsi.switch(value & CR_HSION != 0 || hsi_fed, HSI_START, now);
        let start = Span::from_micros(self.silicon.crystal_start_us.into());
        self.hse.switch(value & CR_HSEON != 0 || hse_fed, start, now);
        self.pll.switch(value & CR_PLLON != 0 || pll_fed, PLL_LOCK, now);
        self.plli2s.switch(value & CR_PLLI2SON != 0, PLL_LOCK, now);
        if self.hse_hz == 0 && value & CR_HSEON != 0 {
            return unmodelled("HSEON is set, but this board has no crystal: HSERDY will never come");
        }
        if value & CR_PLLSAION != 0 {
            return unmodelled("the PLL for SAI and display is not modelled");
        }
        Ok(())
    }
}

impl Peripheral for Rcc {
    fn name(&self) -> &'static str {
        "RCC"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        self.advance(now);
        Ok(match offset {
            0x00 => self.cr(now),
            0x08 => self.cfgr | self.sws << 2,
            BDCR => self.bdcr_rest | self.lse.bits(BDCR_LSEON, BDCR_LSERDY, now),
            0x74 => self.csr_flags | self.lsi.bits(CSR_LSION, CSR_LSIRDY, now),
            // CIR; the interrupts of ready clocks: see `write`.
            0x0C if self.has_failed => CIR_CSSF,
            0x0C => 0,
            _ => match self.plain.iter().find(|register| register.at == offset) {
                Some(register) => register.value,
                None => return Err(self.unknown()),
            },
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        self.advance(now);
        match offset {
            0x00 => {
                let result = self.write_cr(value, now);
                self.follow_sw(now);
                return result;
            }
            PLLCFGR if self.pll.is_on() => {
                return unmodelled("PLLCFGR is written while the PLL is on: the chip ignores it");
            }
            SSCGR if self.pll.is_on() => {
                return unmodelled("SSCGR is written while the PLL is on, which is not allowed");
            }
            0x08 => {
                self.cfgr = value & !0b1100;
                self.follow_sw(now);
            }
            0x0C if value & 0xFF_FF00 & !0x9F_0000 != 0 => {
                return unmodelled("the clock interrupts are not modelled");
            }
            0x0C => self.has_failed &= value & CIR_CSSC == 0,
            BDCR => {
                let start = Span::from_millis(self.silicon.lse_start_ms.into());
                self.lse.switch(value & BDCR_LSEON != 0, start, now);
                let chosen = self.bdcr_rest & BDCR_RTCSEL;
                self.bdcr_rest = value & 0x0001_8304;
                if value & BDCR_BDRST != 0 {
                    self.lse = Source::Off;
                    self.bdcr_rest = BDCR_BDRST;
                } else if chosen != 0 && value & BDCR_RTCSEL != chosen {
                    self.bdcr_rest = self.bdcr_rest & !BDCR_RTCSEL | chosen;
                    return unmodelled(
                        "RTCSEL is chosen until a backup domain reset (BDRST): the chip ignores it",
                    );
                }
            }
            0x74 => {
                self.lsi.switch(value & CSR_LSION != 0, LSI_START, now);
                if value & CSR_RMVF != 0 {
                    self.csr_flags = 0;
                }
            }
            _ => {
                let register = self.plain.iter_mut().find(|register| register.at == offset);
                let is_there = register.is_some_and(|register| {
                    // Reserved bits stay what they are after a reset.
                    register.value = value & register.bits | register.reset & !register.bits;
                    register.bits != 0 || value == 0
                });
                if !is_there {
                    return Err(self.unknown());
                }
            }
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        self.now = now;
        self.follow_sw(now);
    }

    fn next_event(&self) -> Option<Time> {
        // Only a pending switch of the system clock acts by itself; the ready flags are computed
        // when read.
        if self.cfgr & 3 == self.sws {
            return None;
        }
        match self.cfgr & 3 {
            0 => self.hsi.next_event(self.now),
            1 => self.hse.next_event(self.now),
            2 => self.pll.next_event(self.now),
            _ => None,
        }
    }

    /// System reset: everything but the reset flags, the LSI's request and the backup domain
    /// (section 7.1.1).
    fn reset(&mut self) {
        let fresh = Self::new(self.variant, self.hse_hz, self.silicon);
        *self = Self {
            csr_flags: self.csr_flags,
            lse: self.lse,
            bdcr_rest: self.bdcr_rest,
            now: self.now,
            ..fresh
        };
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::{STM32F407VG, STM32F429ZI, STM32F446RE};

    use super::*;
    use crate::silicon::TYPICAL;
    use crate::variant;

    fn f407(hse_hz: u32) -> Rcc {
        Rcc::new(variant::of(&STM32F407VG), hse_hz, TYPICAL)
    }

    const MS: u64 = 1_000_000_000;

    /// The usual set-up of the F407: 8 MHz crystal, M 8, N 336, P 2 give 168 MHz, APB1 a quarter,
    /// APB2 a half.
    #[test]
    fn the_pll_makes_168_mhz_from_an_8_mhz_crystal() {
        let mut rcc = f407(8_000_000);
        let hsi = 16_000_000;
        assert_eq!(rcc.clocks(), Clocks { hclk: hsi, pclk1: hsi, pclk2: hsi, timclk1: hsi, timclk2: hsi });
        rcc.write(0x00, CR_RESET | CR_HSEON, Time(0)).unwrap();
        assert_eq!(rcc.read(0x00, Time(2 * MS - 1)).unwrap() & CR_HSERDY, 0);
        assert_eq!(rcc.read(0x00, Time(2 * MS)).unwrap() & CR_HSERDY, CR_HSERDY);
        rcc.write(PLLCFGR, 1 << 22 | 336 << 6 | 8, Time(2 * MS)).unwrap();
        rcc.write(0x00, CR_RESET | CR_HSEON | CR_PLLON, Time(2 * MS)).unwrap();
        // PPRE1 /4, PPRE2 /2, SW = PLL: asked for before the PLL is ready.
        rcc.write(0x08, 0b100 << 13 | 0b101 << 10 | 2, Time(2 * MS)).unwrap();
        assert_eq!(rcc.clocks().hclk, 16_000_000);
        assert_eq!(rcc.next_event(), Some(Time(2 * MS) + PLL_LOCK));
        rcc.advance(Time(3 * MS));
        let Clocks { hclk, pclk1, pclk2, timclk1, timclk2 } = rcc.clocks();
        let mhz = [hclk, pclk1, pclk2, timclk1, timclk2].map(|hz| f64::from(hz) / 1e6);
        assert_eq!(mhz, [168.0, 42.0, 84.0, 84.0, 168.0]);
        assert_eq!(rcc.read(0x08, Time(3 * MS)).unwrap() & 0b1100, 0b1000);
        // Neither the PLL nor its source can be switched off now.
        rcc.write(0x00, CR_RESET, Time(3 * MS)).unwrap();
        assert_eq!(rcc.clocks().hclk, 168_000_000);
        assert!(rcc.write(PLLCFGR, 0, Time(3 * MS)).is_err());
        rcc.reset();
        assert_eq!(rcc.clocks().hclk, 16_000_000);
    }

    /// Section 6.3.25: without TIMPRE twice the bus's clock, with it four times, HCLK at most.
    #[test]
    fn timpre_gives_the_timers_four_times_the_clock_of_their_bus() {
        let mut rcc = Rcc::new(variant::of(&STM32F429ZI), 8_000_000, TYPICAL);
        // PPRE2 /8, PPRE1 /4.
        rcc.write(0x08, 0b110 << 13 | 0b101 << 10, Time(0)).unwrap();
        assert_eq!((rcc.clocks().timclk1, rcc.clocks().timclk2), (8_000_000, 4_000_000));
        rcc.write(DCKCFGR, DCKCFGR_TIMPRE, Time(0)).unwrap();
        assert_eq!((rcc.clocks().timclk1, rcc.clocks().timclk2), (16_000_000, 8_000_000));
    }

    #[test]
    fn reset_values_are_those_of_the_manual() {
        let mut rcc = f407(8_000_000);
        for (offset, value) in [
            (0x00, 0x0000_0083),
            (0x04, 0x2400_3010),
            (0x08, 0),
            (0x30, 0x0010_0000),
            (0x50, 0x7E67_91FF),
            (0x60, 0x36FE_C9FF),
            (0x74, 0x0E00_0000),
            (0x84, 0x2000_3000),
        ] {
            assert_eq!(rcc.read(offset, Time(0)), Ok(value), "offset {offset:02X}h");
        }
    }

    #[test]
    fn reset_flags_gather_until_they_are_removed() {
        let mut rcc = f407(8_000_000);
        rcc.write(0x74, CSR_RMVF, Time(0)).unwrap();
        assert_eq!(rcc.read(0x74, Time(0)), Ok(0));
        rcc.note_reset(ResetCause::Software);
        rcc.reset();
        assert_eq!(rcc.read(0x74, Time(0)), Ok(0x1400_0000));
        rcc.note_reset(ResetCause::IndependentWatchdog);
        assert_eq!(rcc.read(0x74, Time(0)), Ok(0x3400_0000));
        rcc.note_reset(ResetCause::WindowWatchdog);
        assert_eq!(rcc.read(0x74, Time(0)), Ok(0x7400_0000));
        rcc.note_reset(ResetCause::LowPower);
        assert_eq!(rcc.read(0x74, Time(0)), Ok(0xF400_0000));
    }

    /// No manual says which flag a wake-up from Standby sets.
    #[test]
    fn a_wake_up_from_standby_sets_the_flags_of_the_chip() {
        for (flags_after_standby, csr) in [(false, 0), (true, 0x0E00_0000)] {
            let silicon = Silicon { flags_after_standby, ..TYPICAL };
            let mut rcc = Rcc::new(variant::of(&STM32F407VG), 8_000_000, silicon);
            rcc.write(0x74, CSR_RMVF, Time(0)).unwrap();
            rcc.note_reset(ResetCause::Standby);
            rcc.reset();
            assert_eq!(rcc.read(0x74, Time(0)), Ok(csr));
        }
    }

    /// Section 7.3.23: INCSTEP = md × PLLN × (2^15 - 1) / (100 × 5 × MODPER); 250 and 88 are 2 % at PLLN
    /// 168. In down-spread mode the mean is 1 % lower.
    #[test]
    fn down_spread_slows_the_clock() {
        for (sscgr, hclk) in [(0, 168_000_000), (0x8000_0000, 168_000_000), (0xC000_0000, 166_320_000)] {
            let mut rcc = f407(8_000_000);
            let spread = sscgr | 88 << 13 | 250;
            rcc.write(SSCGR, spread, Time(0)).unwrap();
            // M 8, N 168, P 2 from HSI.
            rcc.write(PLLCFGR, 168 << 6 | 8, Time(0)).unwrap();
            rcc.write(0x00, CR_RESET | CR_PLLON, Time(0)).unwrap();
            assert!(rcc.write(SSCGR, 0, Time(0)).is_err());
            rcc.write(0x08, 2, Time(MS)).unwrap();
            let parts = rcc.clocks().hclk.abs_diff(hclk) / 168;
            assert!(parts < 500, "{sscgr:08X}: {} Hz", rcc.clocks().hclk);
        }
    }

    #[test]
    fn without_a_crystal_hse_never_gets_ready() {
        let mut rcc = f407(0);
        assert!(rcc.write(0x00, CR_RESET | CR_HSEON, Time(0)).is_err());
        assert_eq!(rcc.read(0x00, Time(u64::MAX)).unwrap() & CR_HSERDY, 0);
    }

    /// The lines of the family have different enable bits: port I of the F407, the clock gates of
    /// the F446.
    #[test]
    fn registers_and_bits_are_those_of_the_chip() {
        const CKGATENR: u32 = 0x90;
        let mut f407 = f407(8_000_000);
        let mut f446 = Rcc::new(variant::of(&STM32F446RE), 8_000_000, TYPICAL);
        for (rcc, there) in [(&mut f407, 0x1FF), (&mut f446, 0x0FF)] {
            // As the PACs of both have it.
            assert_eq!(rcc.plain(AHB1ENR), 0x0010_0000);
            rcc.write(AHB1ENR, 0x7FF, Time(0)).unwrap();
            assert_eq!(rcc.plain(AHB1ENR), there);
        }
        assert!(f407.read(CKGATENR, Time(0)).is_err() && f407.write(CKGATENR, 1, Time(0)).is_err());
        f446.write(CKGATENR, 1, Time(0)).unwrap();
        assert_eq!(f446.read(CKGATENR, Time(0)), Ok(1));
    }
}
