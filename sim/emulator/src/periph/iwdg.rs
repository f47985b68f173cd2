//! Independent watchdog (RM0090 section 21).

use crate::clock::{picos_of, ticks_in};
use crate::peripheral::{Peripheral, Unmodelled};
use crate::time::{Span, Time};

/// Nominal frequency of the low-speed internal oscillator (datasheet DocID022152, LSI
/// characteristics: 17 to 47 kHz).
pub const LSI_HZ: u64 = 32_000;

const KEY_RELOAD: u32 = 0xAAAA;
const KEY_ACCESS: u32 = 0x5555;
const KEY_START: u32 = 0xCCCC;
const SR_PVU: u32 = 1 << 0;
const SR_RVU: u32 = 1 << 1;

/// A value that was written takes up to five LSI cycles to get across the clock domains (section
/// 21.4.4).
const UPDATE: Span = Span(5 * 1_000_000_000_000 / LSI_HZ);

/// The watchdog. Once started only a reset stops it.
#[derive(Clone, Debug)]
pub struct Iwdg {
    prescaler: u32,
    reload: u32,
    unlocked: bool,
    /// When the counter was last loaded, if it runs.
    loaded: Option<Time>,
    prescaler_update_ends: Time,
    reload_update_ends: Time,
    expired: bool,
}

impl Default for Iwdg {
    fn default() -> Self {
        Self {
            prescaler: 0,
            reload: 0xFFF,
            unlocked: false,
            loaded: None,
            prescaler_update_ends: Time(0),
            reload_update_ends: Time(0),
            expired: false,
        }
    }
}

impl Iwdg {
    /// Whether it was started.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.loaded.is_some()
    }

    /// Whether it ran out; the machine resets the chip then.
    #[must_use]
    pub fn has_expired(&self) -> bool {
        self.expired
    }

    /// The prescaler divides by 4 << PR, at most 256.
    fn counter_ticks(&self) -> u64 {
        (u64::from(self.reload) + 1) * (4 << self.prescaler.min(6))
    }

    fn expires(&self) -> Option<Time> {
        self.loaded.map(|loaded| loaded + Span(picos_of(self.counter_ticks(), LSI_HZ)))
    }
}

impl Peripheral for Iwdg {
    fn name(&self) -> &'static str {
        "IWDG"
    }

    fn read(&mut self, offset: u32, now: Time) -> Result<u32, Unmodelled> {
        Ok(match offset {
            0x00 => 0,
            0x04 => self.prescaler,
            0x08 => self.reload,
            0x0C => {
                let flag = |ends: Time, bit| if now < ends { bit } else { 0 };
                flag(self.prescaler_update_ends, SR_PVU) | flag(self.reload_update_ends, SR_RVU)
            }
            _ => return Err(Unmodelled("the IWDG has no such register".into())),
        })
    }

    fn write(&mut self, offset: u32, value: u32, now: Time) -> Result<(), Unmodelled> {
        match offset {
            0x00 => {
                let key = value & 0xFFFF;
                self.unlocked = key == KEY_ACCESS;
                match key {
                    KEY_RELOAD if self.loaded.is_some() => self.loaded = Some(now),
                    KEY_START if self.loaded.is_none() => self.loaded = Some(now),
                    KEY_RELOAD | KEY_START | KEY_ACCESS | 0 => {}
                    _ => return Err(Unmodelled("the IWDG knows no such key".into())),
                }
            }
            0x04 | 0x08 if !self.unlocked => {
                return Err(Unmodelled(
                    "IWDG_PR and IWDG_RLR are write protected: write 5555h to KR first".into(),
                ));
            }
            0x04 => {
                self.rescale(now, value & 7, self.reload);
                self.prescaler_update_ends = now + UPDATE;
            }
            0x08 => {
                self.rescale(now, self.prescaler, value & 0xFFF);
                self.reload_update_ends = now + UPDATE;
            }
            0x0C => {}
            _ => return Err(Unmodelled("the IWDG has no such register".into())),
        }
        Ok(())
    }

    fn advance(&mut self, now: Time) {
        if self.expires().is_some_and(|expires| now >= expires) {
            self.expired = true;
        }
    }

    fn next_event(&self) -> Option<Time> {
        if self.expired {
            None
        } else {
            self.expires()
        }
    }

    fn interrupts(&self, _active: &mut Vec<u16>) {}

    fn reset(&mut self) {
        *self = Self::default();
    }
}

impl Iwdg {
    /// A new prescaler or reload value. The counter itself keeps its value until the next reload:
    /// its remaining ticks are counted at the new rate.
    fn rescale(&mut self, now: Time, prescaler: u32, reload: u32) {
        if let Some(loaded) = self.loaded {
            let old_divider = 4u64 << self.prescaler.min(6);
            let new_divider = 4u64 << prescaler.min(6);
            let passed = ticks_in((now - loaded).0, LSI_HZ) / old_divider;
            let left = (u64::from(self.reload) + 1).saturating_sub(passed);
            // `loaded` moves so that exactly `left` counts remain under the new values.
            let total = (u64::from(reload) + 1) * new_divider;
            let elapsed = total.saturating_sub(left * new_divider);
            self.loaded = Some(Time(now.0.saturating_sub(picos_of(elapsed, LSI_HZ))));
        }
        self.prescaler = prescaler;
        self.reload = reload;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000_000;

    /// RM0090 table 107: with the prescaler at /4 and RL = FFFh the time-out is 512 ms.
    #[test]
    fn runs_out_after_the_time_of_the_manual() {
        let mut dog = Iwdg::default();
        dog.write(0x00, 0xCCCC, Time(0)).unwrap();
        assert_eq!(dog.next_event(), Some(Time(512 * MS)));
        dog.advance(Time(512 * MS - 1));
        assert!(!dog.has_expired());
        dog.write(0x00, 0xAAAA, Time(100 * MS)).unwrap();
        dog.advance(Time(512 * MS));
        assert!(!dog.has_expired());
        dog.advance(Time(612 * MS));
        assert!(dog.has_expired());
    }

    /// RM0090 table 107: /32 and RL = 0 give 1 ms.
    #[test]
    fn prescaler_and_reload_need_the_access_key() {
        let mut dog = Iwdg::default();
        assert!(dog.write(0x04, 3, Time(0)).is_err());
        dog.write(0x00, 0x5555, Time(0)).unwrap();
        dog.write(0x04, 3, Time(0)).unwrap();
        dog.write(0x08, 0, Time(0)).unwrap();
        assert_eq!(dog.read(0x0C, Time(0)), Ok(3));
        assert_eq!(dog.read(0x0C, Time(MS)), Ok(0));
        dog.write(0x00, 0xCCCC, Time(0)).unwrap();
        assert_eq!(dog.next_event(), Some(Time(MS)));
        assert!(dog.write(0x08, 5, Time(0)).is_err(), "any other key locks again");
    }
}
