//! Which exception is pending, active, enabled, and which one the CPU takes next.

/// NMI.
pub const NMI: u16 = 2;
/// HardFault.
pub const HARD_FAULT: u16 = 3;
/// MemManage.
pub const MEM_MANAGE: u16 = 4;
/// BusFault.
pub const BUS_FAULT: u16 = 5;
/// UsageFault.
pub const USAGE_FAULT: u16 = 6;
/// SVCall.
pub const SV_CALL: u16 = 11;
/// DebugMonitor.
pub const DEBUG_MONITOR: u16 = 12;
/// PendSV.
pub const PEND_SV: u16 = 14;
/// SysTick.
pub const SYS_TICK: u16 = 15;
/// The exception number of interrupt line 0.
pub const FIRST_LINE: u16 = 16;

/// Execution priority of a thread that nothing masks: below every exception (DDI 0403E B1.5.4).
pub const THREAD_PRIORITY: i32 = 256;

/// The STM32F4 implements the upper four bits of a priority (PM0214 section 4.3.7).
pub const PRIORITY_MASK: u8 = 0xF0;

/// Number of exceptions that a `u128` set can hold.
const MAX: usize = 128;

/// The CPU's mask registers at one moment.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Masks {
    /// PRIMASK.
    pub primask: bool,
    /// FAULTMASK.
    pub faultmask: bool,
    /// BASEPRI; 0 masks nothing.
    pub basepri: u8,
}

/// State of all exceptions, by exception number.
#[derive(Clone, Debug)]
pub struct Exceptions {
    pending: u128,
    active: u128,
    /// Interrupt lines only; the enables of the faults are in [`Self::set_enabled`] too, under
    /// their numbers.
    enabled: u128,
    /// Lines that the peripherals hold high at the moment.
    level: u128,
    priority: [u8; MAX],
    /// AIRCR.PRIGROUP.
    pub prigroup: u8,
    count: u16,
}

impl Exceptions {
    /// A core with `lines` interrupt lines, as after reset.
    ///
    /// # Panics
    /// When the chip has more than 112 lines: the set would not hold them.
    #[must_use]
    pub fn new(lines: u16) -> Self {
        let count = FIRST_LINE + lines;
        assert!(usize::from(count) <= MAX, "more interrupt lines than the model holds");
        let always = bit(NMI) | bit(HARD_FAULT) | bit(SV_CALL) | bit(PEND_SV) | bit(SYS_TICK);
        Self { pending: 0, active: 0, enabled: always, level: 0, priority: [0; MAX], prigroup: 0, count }
    }

    /// Number of exceptions, the first 16 included.
    #[must_use]
    pub fn count(&self) -> u16 {
        self.count
    }

    /// Makes `number` pending. Numbers that the chip does not have stay quiet.
    pub fn pend(&mut self, number: u16) {
        if number < self.count {
            self.pending |= bit(number);
        }
    }

    /// Takes the pending state away; a line that is still high comes back at the next
    /// [`Self::set_levels`].
    pub fn unpend(&mut self, number: u16) {
        if number < self.count {
            self.pending &= !bit(number);
        }
    }

    /// Whether `number` is pending.
    #[must_use]
    pub fn is_pending(&self, number: u16) -> bool {
        number < self.count && self.pending & bit(number) != 0
    }

    /// Whether `number` is active.
    #[must_use]
    pub fn is_active(&self, number: u16) -> bool {
        number < self.count && self.active & bit(number) != 0
    }

    /// Whether `number` is enabled.
    #[must_use]
    pub fn is_enabled(&self, number: u16) -> bool {
        number < self.count && self.enabled & bit(number) != 0
    }

    /// Enables or disables `number`.
    pub fn set_enabled(&mut self, number: u16, enabled: bool) {
        if number < self.count {
            if enabled {
                self.enabled |= bit(number);
            } else {
                self.enabled &= !bit(number);
            }
        }
    }

    /// The priority byte of `number`; 0 where it has none.
    #[must_use]
    pub fn priority(&self, number: u16) -> u8 {
        self.priority.get(usize::from(number)).copied().unwrap_or(0)
    }

    /// Sets the priority byte of `number`; the low four bits do not exist.
    pub fn set_priority(&mut self, number: u16, priority: u8) {
        if number < self.count {
            self.priority[usize::from(number)] = priority & PRIORITY_MASK;
        }
    }

    /// Takes over which lines (interrupt numbers) are high. A high line becomes pending unless its
    /// handler is active (PM0214 section 4.3.9).
    pub fn set_levels(&mut self, lines: &[u16]) {
        self.level = 0;
        for &line in lines {
            if line < self.count - FIRST_LINE {
                self.level |= bit(FIRST_LINE + line);
            }
        }
        self.pending |= self.level & !self.active;
    }

    /// Whether anything at all is pending and enabled.
    #[must_use]
    pub fn any_pending(&self) -> bool {
        self.pending & self.enabled != 0
    }

    /// The pending and enabled exception that comes first, with its group priority.
    #[must_use]
    pub fn first_pending(&self) -> Option<(u16, i32)> {
        let mut left = self.pending & self.enabled;
        let mut first: Option<(u16, i32, i32)> = None;
        while left != 0 {
            let number = u16::try_from(left.trailing_zeros()).unwrap_or(0);
            left &= left - 1;
            let full = self.full_priority(number);
            if first.is_none_or(|(_, _, best)| full < best) {
                first = Some((number, self.group_priority(number), full));
            }
        }
        first.map(|(number, group, _)| (number, group))
    }

    fn full_priority(&self, number: u16) -> i32 {
        match number {
            NMI => -2,
            HARD_FAULT => -1,
            _ => i32::from(self.priority(number)),
        }
    }

    /// The part of the priority that decides about pre-emption (PM0214 section 4.4.5, PRIGROUP).
    #[must_use]
    pub fn group_priority(&self, number: u16) -> i32 {
        match number {
            NMI => -2,
            HARD_FAULT => -1,
            _ => i32::from(self.priority(number)) & self.group_mask(),
        }
    }

    fn group_mask(&self) -> i32 {
        !((2 << i32::from(self.prigroup & 7)) - 1) & 0xFF
    }

    /// What a pending exception must beat to be taken now (DDI 0403E B1.5.4).
    #[must_use]
    pub fn execution_priority(&self, masks: Masks) -> i32 {
        let mut priority = THREAD_PRIORITY;
        let mut left = self.active;
        while left != 0 {
            let number = u16::try_from(left.trailing_zeros()).unwrap_or(0);
            left &= left - 1;
            priority = priority.min(self.group_priority(number));
        }
        if masks.basepri & PRIORITY_MASK != 0 {
            priority = priority.min(i32::from(masks.basepri & PRIORITY_MASK) & self.group_mask());
        }
        if masks.primask {
            priority = priority.min(0);
        }
        if masks.faultmask {
            priority = priority.min(-1);
        }
        priority
    }

    /// The exception that the CPU takes now, if one is pending and beats the execution priority.
    #[must_use]
    pub fn deliverable(&self, masks: Masks) -> Option<u16> {
        let (number, group) = self.first_pending()?;
        (group < self.execution_priority(masks)).then_some(number)
    }

    /// Whether WFI ends: an exception is pending that would be taken if PRIMASK were clear (PM0214
    /// section 2.5.3).
    #[must_use]
    pub fn wakes(&self, masks: Masks) -> bool {
        self.deliverable(Masks { primask: false, ..masks }).is_some()
    }

    /// The CPU enters the handler of `number`.
    pub fn enter(&mut self, number: u16) {
        self.pending &= !bit(number);
        self.active |= bit(number);
    }

    /// The CPU leaves the handler of `number`; a line that is still high is pending again.
    pub fn leave(&mut self, number: u16) {
        self.active &= !bit(number);
        self.pending |= self.level & bit(number);
    }

    /// Sets or clears the active state by hand (SHCSR).
    pub fn set_active(&mut self, number: u16, active: bool) {
        if active {
            self.active |= bit(number);
        } else {
            self.active &= !bit(number);
        }
    }

    /// Number of active exceptions.
    #[must_use]
    pub fn active_count(&self) -> u32 {
        self.active.count_ones()
    }

    /// The 32 interrupt lines from `32 * word` on, as a register shows a set of them.
    #[must_use]
    pub fn lines(&self, set: LineSet, word: u32) -> u32 {
        let bits = match set {
            LineSet::Enabled => self.enabled,
            LineSet::Pending => self.pending,
            LineSet::Active => self.active,
        };
        let shift = u32::from(FIRST_LINE) + 32 * word;
        if shift >= 128 {
            return 0;
        }
        #[allow(clippy::cast_possible_truncation)] // the low word is what is asked for
        let word = (bits >> shift) as u32;
        word
    }
}

/// A set of interrupt lines that a row of NVIC registers shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LineSet {
    /// ISER, ICER.
    Enabled,
    /// ISPR, ICPR.
    Pending,
    /// IABR.
    Active,
}

fn bit(number: u16) -> u128 {
    1 << u32::from(number)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_lines() -> Exceptions {
        let mut exceptions = Exceptions::new(82);
        for line in [3, 7] {
            exceptions.set_enabled(FIRST_LINE + line, true);
            exceptions.pend(FIRST_LINE + line);
        }
        exceptions
    }

    #[test]
    fn the_lower_number_wins_among_equals_and_the_lower_priority_value_among_all() {
        let mut exceptions = two_lines();
        assert_eq!(exceptions.deliverable(Masks::default()), Some(FIRST_LINE + 3));
        exceptions.set_priority(FIRST_LINE + 3, 0x20);
        exceptions.set_priority(FIRST_LINE + 7, 0x10);
        assert_eq!(exceptions.deliverable(Masks::default()), Some(FIRST_LINE + 7));
    }

    /// PM0214 table 44: PRIGROUP 5 leaves bits 7 and 6 for the group, bits 5 and 4 for the
    /// subpriority.
    #[test]
    fn a_subpriority_orders_but_does_not_pre_empt() {
        let mut exceptions = two_lines();
        exceptions.prigroup = 5;
        exceptions.set_priority(FIRST_LINE + 3, 0x70);
        exceptions.set_priority(FIRST_LINE + 7, 0x60);
        assert_eq!(exceptions.deliverable(Masks::default()), Some(FIRST_LINE + 7), "subpriority orders");
        exceptions.enter(FIRST_LINE + 7);
        exceptions.set_priority(FIRST_LINE + 3, 0x40);
        assert_eq!(exceptions.deliverable(Masks::default()), None, "same group");
        exceptions.set_priority(FIRST_LINE + 3, 0x30);
        assert_eq!(exceptions.deliverable(Masks::default()), Some(FIRST_LINE + 3), "better group");
    }

    #[test]
    fn masks_hold_back_what_they_name() {
        let mut exceptions = two_lines();
        exceptions.set_priority(FIRST_LINE + 3, 0x30);
        exceptions.set_priority(FIRST_LINE + 7, 0x40);
        let basepri = |basepri| Masks { basepri, ..Masks::default() };
        assert_eq!(exceptions.deliverable(basepri(0x40)), Some(FIRST_LINE + 3));
        assert_eq!(exceptions.deliverable(basepri(0x30)), None);
        assert_eq!(
            exceptions.deliverable(basepri(0x0F)),
            Some(FIRST_LINE + 3),
            "only the upper four bits exist"
        );
        let primask = Masks { primask: true, ..Masks::default() };
        assert_eq!(exceptions.deliverable(primask), None);
        assert!(exceptions.wakes(primask));
        exceptions.pend(HARD_FAULT);
        assert_eq!(exceptions.deliverable(primask), Some(HARD_FAULT));
        let faultmask = Masks { faultmask: true, ..Masks::default() };
        assert_eq!(exceptions.deliverable(faultmask), None);
        exceptions.pend(NMI);
        assert_eq!(exceptions.deliverable(faultmask), Some(NMI));
    }

    #[test]
    fn a_line_that_stays_high_is_pending_again_after_its_handler() {
        let mut exceptions = Exceptions::new(82);
        exceptions.set_enabled(FIRST_LINE + 20, true);
        exceptions.set_levels(&[20]);
        assert_eq!(exceptions.deliverable(Masks::default()), Some(FIRST_LINE + 20));
        exceptions.enter(FIRST_LINE + 20);
        exceptions.set_levels(&[20]);
        assert!(!exceptions.is_pending(FIRST_LINE + 20), "not while its handler runs");
        exceptions.leave(FIRST_LINE + 20);
        assert!(exceptions.is_pending(FIRST_LINE + 20));
        exceptions.enter(FIRST_LINE + 20);
        exceptions.set_levels(&[]);
        exceptions.leave(FIRST_LINE + 20);
        assert!(!exceptions.is_pending(FIRST_LINE + 20));
    }

    #[test]
    fn numbers_beyond_the_chip_are_ignored() {
        let mut exceptions = Exceptions::new(82);
        exceptions.pend(FIRST_LINE + 82);
        exceptions.set_enabled(u16::MAX, true);
        exceptions.set_levels(&[200]);
        assert_eq!(exceptions.first_pending(), None);
    }
}
