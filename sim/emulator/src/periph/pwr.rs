//! Power controller (RM0090 section 5, RM0390 section 5).

use crate::peripheral::{Peripheral, Unmodelled};
use crate::time::Time;
use crate::variant::Variant;

const CR_DBP: u32 = 1 << 8;
const CR_FPDS: u32 = 1 << 9;
const CR_LOW_POWER: u32 = 0b11;
const CR_PVD: u32 = 0b1111 << 4;
/// On chips that can do 180 MHz.
const CR_OVER_DRIVE: u32 = 0b11 << 16;
const CSR_VOSRDY: u32 = 1 << 14;

/// Regulator scale and backup-domain access; standby, stop and the voltage detector are not
/// modelled.
#[derive(Clone, Debug)]
pub struct Pwr {
    variant: &'static Variant,
    cr: u32,
    csr: u32,
}

impl Pwr {
    /// As after a reset, on this chip.
    #[must_use]
    pub fn new(variant: &'static Variant) -> Self {
        Self { variant, cr: variant.voltage_scale.1, csr: 0 }
    }

    /// CR.VOS: whether the regulator is at scale 1, which the fastest clocks need.
    #[must_use]
    pub fn is_at_scale_1(&self) -> bool {
        let (scale, _) = self.variant.voltage_scale;
        self.cr & scale == scale
    }

    /// CR.DBP: whether the backup domain may be written.
    #[must_use]
    pub fn backup_writable(&self) -> bool {
        self.cr & CR_DBP != 0
    }
}

impl Peripheral for Pwr {
    fn name(&self) -> &'static str {
        "PWR"
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        match offset {
            0x00 => Ok(self.cr),
            0x04 => Ok(self.csr | CSR_VOSRDY),
            _ => Err(Unmodelled("PWR has no such register".into())),
        }
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        match offset {
            0x00 => {
                // CWUF and CSBF read as zero.
                let (voltage_scale, _) = self.variant.voltage_scale;
                self.cr = value & (voltage_scale | CR_DBP | CR_FPDS | CR_LOW_POWER | CR_PVD);
                if value & CR_PVD != 0 {
                    return Err(Unmodelled("the voltage detector (PVD) is not modelled".into()));
                }
                if value & CR_OVER_DRIVE != 0 {
                    return Err(Unmodelled("over-drive is not modelled, or the chip has none".into()));
                }
            }
            0x04 => {
                self.csr = value & (1 << 8 | 1 << 9);
                if self.csr != 0 {
                    return Err(Unmodelled("wake-up pin and backup regulator are not modelled".into()));
                }
            }
            _ => return Err(Unmodelled("PWR has no such register".into())),
        }
        Ok(())
    }

    fn advance(&mut self, _now: Time) {}

    fn next_event(&self) -> Option<Time> {
        None
    }

    fn interrupts(&self, _active: &mut Vec<u16>) {}

    fn reset(&mut self) {
        *self = Self::new(self.variant);
    }
}
