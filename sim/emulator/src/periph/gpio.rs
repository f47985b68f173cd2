//! General-purpose I/O (RM0090 section 8).

use crate::peripheral::{unmodelled, Peripheral, Unmodelled};
use crate::time::Time;

/// The levels that drive the pins from outside, in one word per level.
#[derive(Clone, Copy, Debug, Default)]
struct Outside {
    driven: u16,
    level: u16,
}

/// One port of sixteen pins.
#[derive(Clone, Debug)]
pub struct Gpio {
    port: char,
    name: &'static str,
    moder: u32,
    otyper: u32,
    ospeedr: u32,
    pupdr: u32,
    odr: u16,
    lckr: u32,
    afr: [u32; 2],
    outside: Outside,
}

const NAMES: [&str; 11] =
    ["GPIOA", "GPIOB", "GPIOC", "GPIOD", "GPIOE", "GPIOF", "GPIOG", "GPIOH", "GPIOI", "GPIOJ", "GPIOK"];
const OUTPUT: u32 = 1;
const ALTERNATE: u32 = 2;

impl Gpio {
    /// Port `port`, one of `'A'` to `'K'`.
    #[must_use]
    pub fn new(port: char) -> Self {
        // PA13, PA14, PA15 and PB3, PB4 wake up as debug pins (section 8.4, reset values).
        let (moder, ospeedr, pupdr) = match port {
            'A' => (0xA800_0000, 0x0C00_0000, 0x6400_0000),
            'B' => (0x0000_0280, 0x0000_00C0, 0x0000_0100),
            _ => (0, 0, 0),
        };
        Self {
            port,
            name: NAMES[port as usize - 'A' as usize],
            moder,
            otyper: 0,
            ospeedr,
            pupdr,
            odr: 0,
            lckr: 0,
            afr: [0; 2],
            outside: Outside::default(),
        }
    }

    fn field(word: u32, pin: u8) -> u32 {
        word >> (2 * u32::from(pin & 15)) & 3
    }

    /// Drives `pin` from outside; `None` releases it.
    pub fn set_outside(&mut self, pin: u8, level: Option<bool>) {
        let bit = 1 << (pin & 15);
        self.outside.driven &= !bit;
        self.outside.level &= !bit;
        if let Some(level) = level {
            self.outside.driven |= bit;
            self.outside.level |= u16::from(level) << (pin & 15);
        }
    }

    /// The level that the program drives at `pin`, if it does.
    #[must_use]
    pub fn driven(&self, pin: u8) -> Option<bool> {
        let bit = 1u16 << (pin & 15);
        let (high, open_drain) = (self.odr & bit != 0, self.otyper & u32::from(bit) != 0);
        (Self::field(self.moder, pin) == OUTPUT && !(open_drain && high)).then_some(high)
    }

    /// The level at `pin`. A push-pull output wins over the outside; an open-drain one pulls low
    /// only; a floating pin reads low.
    #[must_use]
    pub fn level(&self, pin: u8) -> bool {
        let bit = 1u16 << (pin & 15);
        if let Some(level) = self.driven(pin) {
            return level;
        }
        if self.outside.driven & bit != 0 {
            return self.outside.level & bit != 0;
        }
        Self::field(self.pupdr, pin) == 1
    }

    /// The alternate function that the program has given `pin`, if it has (section 8.4.9).
    #[must_use]
    pub fn alternate(&self, pin: u8) -> Option<u8> {
        let pin = pin & 15;
        let function = self.afr[usize::from(pin / 8)] >> (4 * u32::from(pin % 8)) & 0xF;
        (Self::field(self.moder, pin) == ALTERNATE).then_some(function as u8)
    }

    fn idr(&self) -> u32 {
        (0..16).fold(0, |word, pin| word | u32::from(self.level(pin)) << pin)
    }
}

impl Peripheral for Gpio {
    fn name(&self) -> &'static str {
        self.name
    }

    fn read(&mut self, offset: u32, _now: Time) -> Result<u32, Unmodelled> {
        Ok(match offset {
            0x00 => self.moder,
            0x04 => self.otyper,
            0x08 => self.ospeedr,
            0x0C => self.pupdr,
            0x10 => self.idr(),
            0x14 => u32::from(self.odr),
            0x18 => 0,
            0x1C => self.lckr,
            0x20 => self.afr[0],
            0x24 => self.afr[1],
            _ => return unmodelled("a GPIO port has no such register"),
        })
    }

    fn write(&mut self, offset: u32, value: u32, _now: Time) -> Result<(), Unmodelled> {
        #[allow(clippy::cast_possible_truncation)] // sixteen pins
        let low = value as u16;
        match offset {
            0x00 => self.moder = value,
            0x04 => self.otyper = u32::from(low),
            0x08 => self.ospeedr = value,
            0x0C => self.pupdr = value,
            0x10 => {}
            0x14 => self.odr = low,
            // Where both halves name a pin, setting wins (section 8.4.7).
            #[allow(clippy::cast_possible_truncation)]
            0x18 => self.odr = self.odr & !((value >> 16) as u16) | low,
            0x1C => {
                self.lckr = value & 0x1_FFFF;
                return unmodelled("the lock of a GPIO port is not modelled");
            }
            0x20 => self.afr[0] = value,
            0x24 => self.afr[1] = value,
            _ => return unmodelled("a GPIO port has no such register"),
        }
        Ok(())
    }

    fn reset(&mut self) {
        let outside = self.outside;
        *self = Self { outside, ..Self::new(self.port) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bsrr_sets_and_resets_and_setting_wins() {
        let mut port = Gpio::new('D');
        port.write(0x00, 1 << 24 | 1 << 26, Time(0)).unwrap();
        port.write(0x18, 1 << 12, Time(0)).unwrap();
        assert!(port.level(12));
        port.write(0x18, 1 << 28 | 1 << 13, Time(0)).unwrap();
        assert!(!port.level(12) && port.level(13));
        port.write(0x18, 1 << 29 | 1 << 13, Time(0)).unwrap();
        assert!(port.level(13));
    }

    #[test]
    fn an_input_follows_the_outside_or_its_pull() {
        let mut port = Gpio::new('C');
        assert_eq!(port.read(0x10, Time(0)), Ok(0));
        port.write(0x0C, 1 << 6, Time(0)).unwrap();
        assert_eq!(port.read(0x10, Time(0)), Ok(1 << 3), "pulled up");
        port.set_outside(3, Some(false));
        port.set_outside(5, Some(true));
        assert_eq!(port.read(0x10, Time(0)), Ok(1 << 5));
        port.set_outside(3, None);
        assert_eq!(port.read(0x10, Time(0)), Ok(1 << 5 | 1 << 3));
        port.reset();
        assert_eq!(port.read(0x10, Time(0)), Ok(1 << 5), "the outside does not know of a reset");
    }

    /// Section 8.4: MODER 10b, and four bits a pin in AFRL and AFRH.
    #[test]
    fn an_alternate_function_is_one_where_the_mode_says_so() {
        let mut port = Gpio::new('C');
        port.write(0x20, 7 << 8, Time(0)).unwrap();
        port.write(0x24, 8 << 16, Time(0)).unwrap();
        assert_eq!(port.alternate(2), None);
        port.write(0x00, 2 << 4 | 2 << 24, Time(0)).unwrap();
        assert_eq!([2, 12, 3].map(|pin| port.alternate(pin)), [Some(7), Some(8), None]);
    }

    #[test]
    fn an_open_drain_output_pulls_low_only() {
        let mut port = Gpio::new('C');
        port.write(0x00, 1, Time(0)).unwrap();
        port.write(0x04, 1, Time(0)).unwrap();
        port.set_outside(0, Some(true));
        assert!(!port.level(0));
        port.write(0x14, 1, Time(0)).unwrap();
        assert!(port.level(0));
        port.set_outside(0, Some(false));
        assert!(!port.level(0));
    }
}
