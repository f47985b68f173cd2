//! Power controller (RM0090 section 5, RM0390 section 5).

use crate::periph::over_drive::{OverDrive, CR_OVER_DRIVE};
use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::silicon::Silicon;
use crate::supply::{Threshold, NOMINAL};
use crate::time::{Span, Time};
use crate::variant::Variant;

const CR_DBP: u32 = 1 << 8;
const CR_FPDS: u32 = 1 << 9;
const CR_LOW_POWER: u32 = 0b11;
const CR_PDDS: u32 = 1 << 1;
const CR_CWUF: u32 = 1 << 2;
const CR_CSBF: u32 = 1 << 3;
const CR_PVDE: u32 = 1 << 4;
const CR_PLS: u32 = 0b111 << 5;
const CSR_WUF: u32 = 1 << 0;
const CSR_SBF: u32 = 1 << 1;
const CSR_PVDO: u32 = 1 << 2;
/// The pin WKUP, PA0; some lines have more such pins, which are not modelled.
const CSR_EWUP: u32 = 1 << 8;
const CSR_VOSRDY: u32 = 1 << 14;

/// The thresholds of the voltage detector by PLS (datasheet DocID022152, "Embedded reset and power control
/// block characteristics").
const PVD: [Threshold; 8] = [
    Threshold { falling: [1_980, 2_040, 2_080], rising: [2_090, 2_140, 2_190] },
    Threshold { falling: [2_130, 2_190, 2_250], rising: [2_230, 2_300, 2_370] },
    Threshold { falling: [2_290, 2_350, 2_390], rising: [2_390, 2_450, 2_510] },
    Threshold { falling: [2_440, 2_510, 2_560], rising: [2_540, 2_600, 2_650] },
    Threshold { falling: [2_590, 2_660, 2_710], rising: [2_700, 2_760, 2_820] },
    Threshold { falling: [2_650, 2_840, 2_920], rising: [2_860, 2_930, 2_990] },
    Threshold { falling: [2_850, 2_930, 2_990], rising: [2_960, 3_030, 3_100] },
    Threshold { falling: [2_950, 3_030, 3_090], rising: [3_070, 3_140, 3_210] },
];

/// Regulator scale, voltage detector, backup-domain access and Standby; Stop is not modelled.
#[derive(Clone, Debug)]
pub struct Pwr {
    variant: &'static Variant,
    silicon: Silicon,
    cr: u32,
    /// WUF, SBF and EWUP.
    csr: u32,
    /// VDD in mV.
    supply: u32,
    /// PVDO.
    is_low: bool,
    over_drive: OverDrive,
    /// Whether the PLL is on, and whether the system clock comes from it.
    pll_use: (bool, bool),
}

impl Pwr {
    /// As after a reset, on this chip.
    #[must_use]
    pub fn new(variant: &'static Variant, silicon: Silicon) -> Self {
        let over_drive = OverDrive::new(Span::from_micros(silicon.over_drive_us.into()));
        let (_, cr) = variant.voltage_scale;
        let (supply, pll_use) = (NOMINAL, (false, false));
        Self { variant, silicon, cr, csr: 0, supply, is_low: false, over_drive, pll_use }
    }

    /// Whether the PLL is on, and whether the system clock comes from it.
    pub fn set_pll_use(&mut self, pll_use: (bool, bool)) {
        self.pll_use = pll_use;
    }

    /// The over-drive of the regulator.
    #[must_use]
    pub fn over_drive(&self) -> &OverDrive {
        &self.over_drive
    }

    /// CR.DBP: whether the backup domain may be written.
    #[must_use]
    pub fn opens_backup_domain(&self) -> bool {
        self.cr & CR_DBP != 0
    }

    /// VDD has this voltage in mV.
    pub fn set_supply(&mut self, mv: u32) {
        self.supply = mv;
        if self.cr & CR_PVDE != 0 {
            let (falling, rising) = self.pvd();
            self.is_low = mv < if self.is_low { rising } else { falling };
        }
    }

    /// CSR.PVDO, which is EXTI line 16 too: whether the supply is below the threshold of the voltage
    /// detector.
    #[must_use]
    pub fn supply_is_low(&self) -> bool {
        self.is_low
    }

    fn pvd(&self) -> (u32, u32) {
        PVD[((self.cr & CR_PLS) >> 5) as usize].of(self.silicon)
    }

    /// After a change of PVDE or PLS, the supply counts as one that rises: the manual has no time after which
    /// the detector is right, nor what it shows until then.
    fn restart_pvd(&mut self) {
        self.is_low = self.cr & CR_PVDE != 0 && self.supply < self.pvd().1;
    }

    /// A reset by the supply: everything is as after power-on.
    pub fn lose_supply(&mut self) {
        *self = self.fresh();
    }

    /// As after a reset, at the same supply.
    fn fresh(&self) -> Self {
        let over_drive = self.over_drive.fresh();
        Self {
            supply: self.supply,
            pll_use: self.pll_use,
            over_drive,
            ..Self::new(self.variant, self.silicon)
        }
    }

    /// CR.VOS: whether the regulator is at scale 1, which the fastest clocks need.
    #[must_use]
    pub fn is_at_scale_1(&self) -> bool {
        let (scale, _) = self.variant.voltage_scale;
        self.cr & scale == scale
    }

    /// CR.PDDS: whether a deep sleep is Standby.
    #[must_use]
    pub fn chooses_standby(&self) -> bool {
        self.cr & CR_PDDS != 0
    }

    /// The chip enters Standby. Returns whether it wakes up at once, because WUF is set (section 5.3.5).
    pub fn enter_standby(&mut self) -> bool {
        self.csr |= CSR_SBF;
        self.csr & CSR_WUF != 0
    }

    /// The core domain has its supply again: of these registers only CR is as after a reset (section
    /// 5.4).
    pub fn leave_standby(&mut self) {
        *self = Self { csr: self.csr, ..self.fresh() };
    }

    /// Something asks for a wake-up.
    pub fn wake_up(&mut self) {
        self.csr |= CSR_WUF;
    }

    /// A rising edge at the pin WKUP. Returns whether it is a wake-up.
    pub fn wkup_rises(&mut self) -> bool {
        let listens = self.csr & CSR_EWUP != 0;
        if listens {
            self.wake_up();
        }
        listens
    }
}

impl Peripheral for Pwr {
    fn name(&self) -> &'static str {
        "PWR"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        match offset {
            0x00 => Ok(self.cr | self.over_drive.cr()),
            0x04 => {
                let pvdo = if self.is_low { CSR_PVDO } else { 0 };
                Ok(self.csr | CSR_VOSRDY | pvdo | self.over_drive.csr(now))
            }
            _ => unmodelled("PWR has no such register"),
        }
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        match offset {
            0x00 => {
                // CWUF and CSBF read as zero.
                for (clear, flag) in [(CR_CWUF, CSR_WUF), (CR_CSBF, CSR_SBF)] {
                    self.csr &= if value & clear != 0 { !flag } else { u32::MAX };
                }
                let (voltage_scale, _) = self.variant.voltage_scale;
                let before = self.cr;
                self.cr = value & (voltage_scale | CR_DBP | CR_FPDS | CR_LOW_POWER | CR_PVDE | CR_PLS);
                if (before ^ self.cr) & (CR_PVDE | CR_PLS) != 0 {
                    self.restart_pvd();
                }
                if !self.variant.has_over_drive() {
                    if value & CR_OVER_DRIVE != 0 {
                        return unmodelled(format!("the {} has no over-drive", self.variant.name));
                    }
                } else if let Some(wrong) = self.over_drive.write(value, self.pll_use.1, self.supply, now) {
                    return unmodelled(wrong);
                }
                // With two bits, scale 1 to 3, it is so (RM0090 section 5.5.1, RM0402, RM0430, RM0390, RM0386).
                if (before ^ self.cr) & voltage_scale != 0 && voltage_scale == 3 << 14 && self.pll_use.0 {
                    return unmodelled("VOS is written while the PLL is on, which is not allowed");
                }
            }
            0x04 => {
                self.csr = self.csr & !CSR_EWUP | value & CSR_EWUP;
                if value & 1 << 9 != 0 {
                    return unmodelled("the backup regulator is not modelled");
                }
            }
            _ => return unmodelled("PWR has no such register"),
        }
        Ok(())
    }

    /// A system reset leaves SBF alone (section 5.4.2).
    fn reset(&mut self) {
        *self = Self { csr: self.csr & CSR_SBF, ..self.fresh() };
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::geometry::STM32F407VG;

    use super::*;
    use crate::silicon::TYPICAL;
    use crate::variant;

    const CR: u32 = 0x00;
    const CSR: u32 = 0x04;

    /// RM0090 section 5.2.3 and the datasheet: the threshold that PLS chooses, with its hysteresis.
    #[test]
    fn the_voltage_detector_compares_the_supply_with_its_threshold() {
        for (pls, falling, rising) in [(0, 2_040, 2_140), (4, 2_660, 2_760), (7, 3_030, 3_140)] {
            let mut pwr = Pwr::new(variant::of(&STM32F407VG), TYPICAL);
            let low = |pwr: &mut Pwr, mv| {
                pwr.set_supply(mv);
                pwr.read(CSR, Time(0)).unwrap() & 1 << 2 != 0
            };
            assert!(!low(&mut pwr, 1_800), "it is off");
            pwr.write(CR, CR_PVDE | pls << 5, Time(0)).unwrap();
            assert!(low(&mut pwr, rising - 1));
            assert!(!low(&mut pwr, rising) && !low(&mut pwr, falling));
            assert!(low(&mut pwr, falling - 1) && low(&mut pwr, rising - 1));
            pwr.reset();
            assert!(!low(&mut pwr, falling - 1), "off again");
            assert_eq!(pwr.read(CR, Time(0)), Ok(0x4000));
        }
    }

    /// RM0090 sections 5.3.5, 5.4.1 and 5.4.2: CSBF and CWUF clear SBF and WUF; a system reset clears WUF and
    /// EWUP, too. With WUF set the chip does not stay in Standby.
    #[test]
    fn standby_is_remembered_until_the_program_clears_it() {
        let mut pwr = Pwr::new(variant::of(&STM32F407VG), TYPICAL);
        assert!(!pwr.chooses_standby());
        pwr.write(CR, CR_PDDS, Time(0)).unwrap();
        assert!(pwr.chooses_standby() && !pwr.enter_standby());
        assert!(!pwr.wkup_rises(), "the pin is not enabled");
        pwr.write(CSR, 1 << 8, Time(0)).unwrap();
        assert!(pwr.wkup_rises());
        pwr.leave_standby();
        assert!(!pwr.chooses_standby());
        assert_eq!(pwr.read(CSR, Time(0)), Ok(0x4103));
        // A write does not clear the flags; and each has its own bit.
        pwr.write(CSR, 0, Time(0)).unwrap();
        assert_eq!(pwr.read(CSR, Time(0)), Ok(0x4003));
        assert!(pwr.enter_standby(), "WUF is still set");
        pwr.write(CR, CR_CSBF, Time(0)).unwrap();
        assert_eq!(pwr.read(CSR, Time(0)), Ok(0x4001));
        pwr.write(CR, CR_CWUF, Time(0)).unwrap();
        assert_eq!((pwr.read(CR, Time(0)), pwr.read(CSR, Time(0))), (Ok(0), Ok(0x4000)));
        pwr.enter_standby();
        pwr.write(CSR, 1 << 8, Time(0)).unwrap();
        pwr.wake_up();
        pwr.reset();
        assert_eq!(pwr.read(CSR, Time(0)), Ok(0x4002), "a system reset");
    }
}
