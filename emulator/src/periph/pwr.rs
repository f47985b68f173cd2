//! Power controller (RM0090 section 5).

use crate::peripheral::{Peripheral, Unmodelled};
use crate::time::Time;

const CR_RESET: u32 = 0x0000_4000;
const CR_VOS: u32 = 1 << 14;
const CR_DBP: u32 = 1 << 8;
const CR_FPDS: u32 = 1 << 9;
const CR_LOW_POWER: u32 = 0b11;
const CR_PVD: u32 = 0b1111 << 4;
const CSR_VOSRDY: u32 = 1 << 14;

/// Regulator scale and backup-domain access; standby, stop and the voltage detector are not modelled.
#[derive(Clone, Debug)]
pub struct Pwr {
    cr: u32,
    csr: u32,
}

impl Default for Pwr {
    fn default() -> Self {
        Self { cr: CR_RESET, csr: 0 }
    }
}

impl Pwr {
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
                self.cr = value & (CR_VOS | CR_DBP | CR_FPDS | CR_LOW_POWER | CR_PVD);
                if value & CR_PVD != 0 {
                    return Err(Unmodelled("the voltage detector (PVD) is not modelled".into()));
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
        *self = Self::default();
    }
}
