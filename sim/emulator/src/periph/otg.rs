//! USB OTG FS without anything on its bus (RM0090 section 34): the registers hold what a program that sets
//! the core up writes, resets and flushes are done at once, and no host ever comes. FIFOs are not modelled.

use std::collections::BTreeMap;

use crate::peripheral::{Peripheral, Unmodelled};
use crate::time::Time;

/// Bytes of its registers: global, host, device, PCGCCTL.
pub const SIZE: u32 = 0x1000;

const GUSBCFG: u32 = 0x00C;
const GRSTCTL: u32 = 0x010;
const GINTSTS: u32 = 0x014;
const HPRT: u32 = 0x440;
const DSTS: u32 = 0x808;

/// GUSBCFG: forced host mode.
const FHMOD: u32 = 1 << 29;
/// GRSTCTL: the number of the FIFO that is flushed; the bits that end by themselves are not kept.
const TXFNUM: u32 = 0x1F << 6;
const AHBIDL: u32 = 1 << 31;
/// GINTSTS: the transmit FIFOs are empty; the core is in host mode.
const EMPTY: u32 = 1 << 26 | 1 << 5;
const CMOD: u32 = 1 << 0;
/// An endpoint's DIEPINT and DOEPINT, whose flags are cleared by a one; all are clear here.
const EPINT: u32 = 0x08;

/// Values after a reset that are not 0 (section 34.16): GUSBCFG, GRXFSIZ, DIEPTXF0, HNPTXSTS, CID, HPTXFSIZ,
/// DIEPTXF1 to DIEPTXF3, DCFG.
const RESET: [(u32, u32); 10] = [
    (GUSBCFG, 0x0000_0A00),
    (0x024, 0x0000_0200),
    (0x028, 0x0000_0200),
    (0x02C, 0x0008_0200),
    (0x03C, 0x0000_1200),
    (0x100, 0x0200_0600),
    (0x104, 0x0200_0400),
    (0x108, 0x0200_0400),
    (0x10C, 0x0200_0400),
    (0x800, 0x0220_0000),
];

/// The core.
#[derive(Clone, Debug)]
pub struct Otg {
    registers: BTreeMap<u32, u32>,
}

impl Default for Otg {
    fn default() -> Self {
        Self { registers: RESET.into() }
    }
}

impl Otg {
    fn value(&self, offset: u32) -> u32 {
        self.registers.get(&offset).copied().unwrap_or(0)
    }
}

/// Whether these are the flags of an endpoint, in or out.
fn is_flags(offset: u32) -> bool {
    (0x900..0xD00).contains(&offset) && offset % 0x20 == EPINT
}

impl Peripheral for Otg {
    fn name(&self) -> &'static str {
        "USB OTG FS"
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        Ok(match offset {
            GRSTCTL => self.value(GRSTCTL) | AHBIDL,
            GINTSTS => EMPTY | if self.value(GUSBCFG) & FHMOD != 0 { CMOD } else { 0 },
            // No frame number, no error, and the speed of a device that is not connected.
            DSTS => 0x10,
            _ => self.value(offset),
        })
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        let kept = match offset {
            // Flags, which are all clear; status; and a port without a device.
            GINTSTS | DSTS | HPRT => return Ok(()),
            _ if is_flags(offset) => return Ok(()),
            GRSTCTL => value & TXFNUM,
            _ => value,
        };
        self.registers.insert(offset, kept);
        Ok(())
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Section 34.16: AHBIDL, CSRST, RXFFLSH and TXFFLSH of GRSTCTL; CMOD of GINTSTS.
    #[test]
    fn resets_and_flushes_end_and_no_host_comes() {
        let mut otg = Otg::default();
        let mut after = |offset, value| {
            otg.write(offset, value, Time(0)).unwrap();
            otg.read(offset, Time(0)).unwrap()
        };
        assert_eq!(after(GRSTCTL, 1), 0x8000_0000);
        assert_eq!(after(GRSTCTL, 0x10 << 6 | 1 << 5 | 1 << 4), 0x8000_0400);
        assert_eq!(after(GINTSTS, u32::MAX), 0x0400_0020);
        assert_eq!((after(0x908, 0xFB7F), after(0xB08, 0xFB7F)), (0, 0));
        assert_eq!(after(0x018, 0x8000_0010), 0x8000_0010);
        otg.write(GUSBCFG, FHMOD, Time(0)).unwrap();
        assert_eq!(otg.read(GINTSTS, Time(0)), Ok(0x0400_0021), "host mode");
        otg.reset();
        assert_eq!((otg.read(GUSBCFG, Time(0)), otg.read(0x018, Time(0))), (Ok(0xA00), Ok(0)));
    }
}
