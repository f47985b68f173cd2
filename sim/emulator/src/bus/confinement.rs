//! Fault confinement: the error counters of a node and the states that follow from them (ISO
//! 11898-1:2015, 12.1.4).

/// The error state of a node, which follows from its counters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ErrorState {
    /// Takes part, and answers errors with six dominant bits that destroy the frame for everyone.
    Active,
    /// Takes part, but its error flags are recessive and it leaves eight more bits free after its
    /// own frames.
    Passive,
    /// Takes no part until 128 × 11 recessive bits have gone by.
    BusOff,
}

/// The transmit and receive error counters of one node.
///
/// Simplified in two points: an error costs a receiver 1, or 9 where the standard's rules (a) and
/// (b) apply together (it saw the error first, and the others' flags follow its own); and no node
/// counts more than once per error frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Confinement {
    tec: u16,
    rec: u8,
}

/// A counter of this value or more sets the warning flag.
const WARNING: u16 = 96;
/// A counter above this makes the node error passive.
const ACTIVE_LIMIT: u16 = 127;
/// A transmit error counter above this puts the node bus-off.
const BUS_OFF_LIMIT: u16 = 255;
/// The receive error counter after a good frame in error passive state; the standard allows 119 to
/// 127, the bxCAN takes 120 (RM0090, CAN_ESR).
const AFTER_PASSIVE: u8 = 120;

impl Confinement {
    /// Transmit error counter; 256 or more in bus-off.
    #[must_use]
    pub fn tec(&self) -> u16 {
        self.tec
    }

    /// Receive error counter.
    #[must_use]
    pub fn rec(&self) -> u8 {
        self.rec
    }

    /// The error state that follows from the counters.
    #[must_use]
    pub fn state(&self) -> ErrorState {
        if self.tec > BUS_OFF_LIMIT {
            ErrorState::BusOff
        } else if self.tec > ACTIVE_LIMIT || u16::from(self.rec) > ACTIVE_LIMIT {
            ErrorState::Passive
        } else {
            ErrorState::Active
        }
    }

    /// Whether a counter has reached 96.
    #[must_use]
    pub fn warning(&self) -> bool {
        self.tec >= WARNING || u16::from(self.rec) >= WARNING
    }

    /// A frame of its own failed. `exempt`: rule (c) exception 1, an error passive transmitter
    /// without an acknowledge that sees no dominant bit during its passive flag.
    pub fn transmit_failed(&mut self, exempt: bool) {
        if !exempt {
            self.tec = (self.tec + 8).min(BUS_OFF_LIMIT + 8);
        }
    }

    /// A frame of its own went out well.
    pub fn transmitted(&mut self) {
        self.tec = self.tec.saturating_sub(1);
    }

    /// A frame of another node was bad; `first`: this node saw the error before the others.
    pub fn receive_failed(&mut self, first: bool) {
        self.rec = self.rec.saturating_add(if first { 9 } else { 1 });
    }

    /// The line has stayed dominant for 8 more bits after an error flag (rule f): the counter of the role
    /// that the node had in the frame rises by 8.
    pub fn stays_dominant(&mut self, own: bool) {
        if own {
            self.transmit_failed(false);
        } else {
            self.rec = self.rec.saturating_add(8);
        }
    }

    /// A frame of another node was good.
    pub fn received(&mut self) {
        self.rec = if self.rec > 127 { AFTER_PASSIVE } else { self.rec.saturating_sub(1) };
    }

    /// 128 × 11 recessive bits are over.
    pub fn recovered(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_of_the_standard() {
        let mut node = Confinement::default();
        for n in 1..=32 {
            node.transmit_failed(false);
            assert_eq!(node.tec(), 8 * n);
            assert_eq!(node.warning(), n >= 12, "96 = 12 x 8");
            let state = match n {
                0..=15 => ErrorState::Active,   // 120
                16..=31 => ErrorState::Passive, // 128 to 248
                _ => ErrorState::BusOff,        // 256
            };
            assert_eq!(node.state(), state, "after {n} errors");
        }
        node.recovered();
        assert_eq!((node.tec(), node.rec(), node.state()), (0, 0, ErrorState::Active));
    }

    #[test]
    fn no_acknowledge_ends_at_error_passive() {
        let mut node = Confinement::default();
        for _ in 0..1000 {
            node.transmit_failed(node.state() == ErrorState::Passive);
        }
        assert_eq!((node.tec(), node.state()), (128, ErrorState::Passive));
        node.transmitted();
        assert_eq!((node.tec(), node.state()), (127, ErrorState::Active));
    }

    #[test]
    fn receivers_count_less_and_come_back() {
        let mut node = Confinement::default();
        node.received();
        assert_eq!(node.rec(), 0);
        node.receive_failed(true);
        node.receive_failed(false);
        node.received();
        assert_eq!(node.rec(), 9);
        for _ in 0..300 {
            node.receive_failed(false);
        }
        assert_eq!((node.rec(), node.state()), (255, ErrorState::Passive));
        node.received();
        assert_eq!((node.rec(), node.state()), (120, ErrorState::Active));
    }
}
