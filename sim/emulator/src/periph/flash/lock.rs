//! The lock of FLASH_CR and that of FLASH_OPTCR, which open by two keys in a row (RM0090 sections
//! 3.5.1 and 3.6.2).

/// State of a lock.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Lock {
    /// As after reset.
    #[default]
    Locked,
    /// The first key was right.
    HalfOpen,
    /// Both were.
    Open,
    /// A key was wrong: shut until the next reset.
    Barred,
}

impl Lock {
    /// Takes a value written to the key register. If the lock becomes [`Self::Barred`], the chip
    /// answers with a bus error.
    ///
    /// An open lock accepts no key: a key is then a wrong sequence, too.
    #[must_use]
    pub fn turn(self, value: u32, keys: [u32; 2]) -> Self {
        match (self, value) {
            (Self::Locked, key) if key == keys[0] => Self::HalfOpen,
            (Self::HalfOpen, key) if key == keys[1] => Self::Open,
            _ => Self::Barred,
        }
    }

    /// The program sets the lock bit. A lock that a wrong key has shut stays shut.
    #[must_use]
    pub fn close(self) -> Self {
        if self == Self::Barred {
            self
        } else {
            Self::Locked
        }
    }

    /// Whether the registers behind the lock may be written.
    #[must_use]
    pub fn is_open(self) -> bool {
        self == Self::Open
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];

    fn turned(keys: &[u32]) -> Lock {
        keys.iter().fold(Lock::default(), |lock, key| lock.turn(*key, KEYS))
    }

    #[test]
    fn both_keys_in_order_open_it_and_nothing_else_does() {
        let [first, second] = KEYS;
        assert_eq!(turned(&[first, second]), Lock::Open);
        for wrong in [&[0][..], &[second], &[first, first], &[first, 0], &[first, second, first]] {
            assert_eq!(turned(wrong), Lock::Barred, "{wrong:X?}");
            let then_right = [wrong, &[first, second]].concat();
            assert_eq!(turned(&then_right), Lock::Barred, "{wrong:X?}, then the right ones");
        }
    }

    #[test]
    fn closing_it_by_hand_asks_for_the_keys_again_and_does_not_mend_a_wrong_one() {
        assert_eq!(turned(&KEYS).close(), Lock::Locked);
        assert_eq!(turned(&[0]).close(), Lock::Barred);
    }
}
