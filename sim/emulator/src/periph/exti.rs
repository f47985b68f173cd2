//! External interrupt controller (RM0090 section 12.2): lines 0 to 15 follow the pins that SYSCFG
//! chooses, line 16 the voltage detector; all 23 can be raised by software.
//!
//! A wake-up by an event (EMR) needs nothing here: WFE ends by itself in this model.

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

const IMR: u32 = 0x00;
const EMR: u32 = 0x04;
const RTSR: u32 = 0x08;
const FTSR: u32 = 0x0C;
const SWIER: u32 = 0x10;
const PR: u32 = 0x14;

const LINES: u32 = 0x007F_FFFF;
/// The lines that come from pins, and from the voltage detector.
const FOLLOWED: u32 = 0x1_FFFF;

/// The interrupt lines of the NVIC, by EXTI line (RM0090 table 62).
const NVIC: [u16; 23] = [6, 7, 8, 9, 10, 23, 23, 23, 23, 23, 40, 40, 40, 40, 40, 40, 1, 41, 42, 62, 76, 2, 3];

/// The controller.
#[derive(Clone, Debug, Default)]
pub struct Exti {
    imr: u32,
    emr: u32,
    rtsr: u32,
    ftsr: u32,
    swier: u32,
    pr: u32,
    /// The levels at lines 0 to 16 when they were last looked at.
    levels: u32,
}

impl Exti {
    /// Whether an edge at lines 0 to 16 has an effect. Only then their levels need to be shown.
    #[must_use]
    pub fn listens(&self) -> bool {
        (self.rtsr | self.ftsr) & FOLLOWED != 0
    }

    /// Sets the present levels at lines 0 to 16; edges since the last call count.
    pub fn show(&mut self, levels: u32) {
        let (new, old) = (levels, self.levels);
        self.pr |= new & !old & self.rtsr | old & !new & self.ftsr;
        self.levels = levels;
    }

    /// Sets the present levels at lines 0 to 16 without an edge.
    pub fn settle(&mut self, levels: u32) {
        self.levels = levels;
    }
}

impl Peripheral for Exti {
    fn name(&self) -> &'static str {
        "EXTI"
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        Ok(match offset {
            IMR => self.imr,
            EMR => self.emr,
            RTSR => self.rtsr,
            FTSR => self.ftsr,
            SWIER => self.swier,
            PR => self.pr,
            _ => return unmodelled("EXTI has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        let value = value & LINES;
        match offset {
            IMR => self.imr = value,
            EMR => self.emr = value,
            RTSR => self.rtsr = value,
            FTSR => self.ftsr = value,
            SWIER => {
                // A 1 over a 0 sets the pending bit (section 12.3.5).
                self.pr |= value & !self.swier;
                self.swier |= value;
            }
            // Writing 1 clears the bit, and that of SWIER with it (sections 12.3.5 and 12.3.6).
            PR => {
                self.pr &= !value;
                self.swier &= !value;
            }
            _ => return unmodelled("EXTI has no such register"),
        }
        if matches!(offset, RTSR | FTSR) && value & !FOLLOWED != 0 {
            return unmodelled("what is behind EXTI lines 17 to 22 (RTC, USB, Ethernet) is not modelled");
        }
        Ok(())
    }

    fn interrupts(&self, active: &mut Vec<u16>) {
        let pending = self.pr & self.imr;
        let of_nvic = (0..).zip(NVIC).filter(|(line, _)| pending & 1 << line != 0);
        active.extend(of_nvic.map(|(_, number)| number));
    }

    fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Section 12.2.5: the edges that RTSR and FTSR name set PR; IMR lets it through.
    #[test]
    fn edges_that_are_asked_for_become_pending() {
        let mut exti = Exti::default();
        exti.write(RTSR, 1 << 3 | 1 << 7, Time(0)).unwrap();
        exti.write(FTSR, 1 << 13 | 1 << 7, Time(0)).unwrap();
        exti.settle(1 << 13);
        exti.show(1 << 13 | 1 << 3);
        assert_eq!((exti.read(PR, Time(0)), exti.active()), (Ok(1 << 3), vec![]), "masked");
        exti.write(IMR, LINES, Time(0)).unwrap();
        assert_eq!(exti.active(), [9]);
        exti.write(PR, 1 << 3, Time(0)).unwrap();
        exti.show(1 << 7);
        assert_eq!(exti.read(PR, Time(0)), Ok(1 << 13 | 1 << 7));
        assert_eq!(exti.active(), [23, 40]);
        exti.write(PR, 1 << 7, Time(0)).unwrap();
        exti.show(0);
        assert_eq!(exti.read(PR, Time(0)), Ok(1 << 13 | 1 << 7), "the other edge");
    }

    /// Section 12.2.5: line 16 is the output of the voltage detector, interrupt 1 (table 62).
    #[test]
    fn the_voltage_detector_is_line_16() {
        let mut exti = Exti::default();
        exti.write(IMR, LINES, Time(0)).unwrap();
        exti.write(RTSR, 1 << 16, Time(0)).unwrap();
        assert!(exti.listens());
        exti.show(1 << 16);
        assert_eq!((exti.read(PR, Time(0)), exti.active()), (Ok(1 << 16), vec![1]));
        assert!(exti.write(RTSR, 1 << 17, Time(0)).is_err());
    }

    /// Section 12.3.5: SWIER.
    #[test]
    fn software_raises_any_line_once() {
        let mut exti = Exti::default();
        exti.write(IMR, 1 << 17, Time(0)).unwrap();
        exti.write(SWIER, 1 << 17, Time(0)).unwrap();
        assert_eq!(exti.active(), [41]);
        exti.write(PR, 1 << 17, Time(0)).unwrap();
        assert_eq!((exti.read(SWIER, Time(0)), exti.active()), (Ok(0), vec![]));
    }
}
