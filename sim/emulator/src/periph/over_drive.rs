//! Over-drive of the regulator, which F42x, F43x, F446 and F469 need above 168 MHz (RM0090 sections 5.1.4 and 5.5,
//! RM0390 and RM0386 likewise).

use crate::time::{Span, Time};

const CR_ODEN: u32 = 1 << 16;
const CR_ODSWEN: u32 = 1 << 17;
const CSR_ODRDY: u32 = 1 << 16;
const CSR_ODSWRDY: u32 = 1 << 17;
/// Its bits of PWR_CR.
pub const CR_OVER_DRIVE: u32 = CR_ODEN | CR_ODSWEN;
/// The lowest supply for it, in mV (RM0090 table 23).
pub const LEAST_SUPPLY: u32 = 2_100;
/// The limits with it, in Hz: HCLK, PCLK1 and PCLK2 (datasheets of F42x, F446 and F469, general operating conditions).
pub const LIMITS: [u32; 3] = [180_000_000, 45_000_000, 90_000_000];

/// ODEN and ODSWEN, and how far the regulator has followed them.
#[derive(Clone, Debug)]
pub struct OverDrive {
    takes: Span,
    cr: u32,
    /// When it has followed the last change of each.
    enabled: Time,
    switched: Time,
}

impl OverDrive {
    /// Off. The regulator takes this time for a change.
    #[must_use]
    pub fn new(takes: Span) -> Self {
        Self { takes, cr: 0, enabled: Time(0), switched: Time(0) }
    }

    /// Off, as after a reset.
    #[must_use]
    pub fn fresh(&self) -> Self {
        Self::new(self.takes)
    }

    /// Its bits of PWR_CR.
    #[must_use]
    pub fn cr(&self) -> u32 {
        self.cr
    }

    /// Its bits of PWR_CSR.
    #[must_use]
    pub fn csr(&self, now: Time) -> u32 {
        let is_ready = self.cr & CR_ODEN != 0 && now >= self.enabled;
        let is_switched = (self.cr & CR_ODSWEN != 0) == (now >= self.switched);
        (if is_ready { CSR_ODRDY } else { 0 }) | (if is_switched { CSR_ODSWRDY } else { 0 })
    }

    /// Whether the chip may run at 180 MHz.
    #[must_use]
    pub fn is_active(&self, now: Time) -> bool {
        self.cr & CR_ODSWEN != 0 && now >= self.switched
    }

    /// Until when the system clock stands still, if the regulator switches.
    #[must_use]
    pub fn stall(&self, now: Time) -> Option<Time> {
        Some(self.switched).filter(|&until| until > now)
    }

    /// A write of PWR_CR, with the system clock from the PLL or not, at this supply in mV. Returns what the manual does
    /// not allow.
    pub fn write(&mut self, cr: u32, from_pll: bool, supply: u32, now: Time) -> Option<&'static str> {
        // "Cleared automatically by hardware [...] when the ODEN bit is reset."
        let cr = if cr & CR_ODEN == 0 { 0 } else { cr & CR_OVER_DRIVE };
        let changed = self.cr ^ cr;
        let wrong = if changed == 0 {
            None
        } else if from_pll {
            Some("ODEN and ODSWEN may change only while HSI or HSE is the system clock")
        } else if changed & cr & CR_ODSWEN != 0 && self.csr(now) & CSR_ODRDY == 0 {
            Some("ODSWEN may be set only after ODRDY (PWR_CSR)")
        } else if cr != 0 && supply < LEAST_SUPPLY {
            Some("there is no over-drive at a supply below 2.1 V")
        } else {
            None
        };
        self.cr = cr;
        if changed & CR_ODEN != 0 {
            self.enabled = now + self.takes;
        }
        if changed & CR_ODSWEN != 0 {
            self.switched = now + self.takes;
        }
        wrong
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const US: u64 = 1_000_000;

    /// The sequences of RM0090 section 5.1.4.
    #[test]
    fn it_is_entered_in_two_steps_and_left_in_one_or_two() {
        let mut over_drive = OverDrive::new(Span::from_micros(45));
        assert_eq!(over_drive.write(1 << 16, false, 3_300, Time(0)), None);
        assert_eq!([44, 45].map(|us| over_drive.csr(Time(us * US))), [0, 1 << 16]);
        assert_eq!(over_drive.stall(Time(45 * US)), None);
        assert_eq!(over_drive.write(3 << 16, false, 3_300, Time(50 * US)), None);
        assert_eq!([94, 95].map(|us| over_drive.csr(Time(us * US))), [1 << 16, 3 << 16]);
        assert_eq!([94, 95].map(|us| over_drive.is_active(Time(us * US))), [false, true]);
        assert_eq!(over_drive.stall(Time(50 * US)), Some(Time(95 * US)));
        // Sequence 2: ODSWEN first. The clock stands still again.
        let mut two = over_drive.clone();
        assert_eq!(two.write(1 << 16, false, 3_300, Time(100 * US)), None);
        assert_eq!([144, 145].map(|us| two.csr(Time(us * US))), [3 << 16, 1 << 16]);
        assert!(!two.is_active(Time(100 * US)) && two.stall(Time(100 * US)).is_some());
        // Sequence 1: both, or ODEN alone, which takes ODSWEN with it.
        for cr in [0, 1 << 17] {
            let mut one = over_drive.clone();
            assert_eq!(one.write(cr, false, 3_300, Time(100 * US)), None);
            assert_eq!(one.cr(), 0);
            assert_eq!([144, 145].map(|us| one.csr(Time(us * US))), [1 << 17, 0]);
        }
    }

    /// Sections 5.1.4 and 5.5.1. A write that changes neither bit breaks nothing.
    #[test]
    fn what_the_manual_does_not_allow_is_named() {
        let mut over_drive = OverDrive::new(Span::from_micros(45));
        let wrong =
            |it: &OverDrive, cr: u32, from_pll, mv| it.clone().write(cr << 16, from_pll, mv, Time(44 * US));
        over_drive.write(1 << 16, false, 3_300, Time(0));
        assert_eq!(wrong(&over_drive, 1, true, 1_800), None);
        assert_eq!(wrong(&over_drive, 0, false, 1_800), None);
        assert!(wrong(&over_drive, 0, true, 3_300).unwrap().contains("HSI or HSE"));
        assert!(wrong(&over_drive, 3, false, 3_300).unwrap().contains("ODRDY"));
        let fresh = over_drive.fresh();
        assert!(wrong(&fresh, 3, false, 3_300).unwrap().contains("ODRDY"), "both at once");
        assert!(wrong(&fresh, 1, false, 2_099).unwrap().contains("2.1 V"));
        assert_eq!(wrong(&fresh, 1, false, 2_100), None);
    }
}
