//! The departure to the bootloader: a state machine that decides when the device may leave.
//!
//! If the application answers the command, the answer goes onto the bus first, and the application
//! still serves requests meanwhile ([`Departure::begin`]). If the bootloader is to answer, the
//! application sends nothing any more ([`Departure::begin_silent`]).

/// How long the device stays after its answer is on the bus, in ms. At least 10 are required (SYS
/// TEC manual L-1112d_10, 4.5); one more is added because the present millisecond may be almost
/// over.
pub const ANSWER_TO_RESET_MS: u32 = 11;
/// The longest time that the device stays after a command, in ms. It leaves then even if no node
/// acknowledges the answer, or if a client sends requests without end.
pub const ANSWERED_MOST_MS: u32 = 500;
/// The longest time that the device waits for frames on their way to the bus when the bootloader is
/// to answer, in ms. The client must get its answer within 25 ms.
pub const SILENT_MOST_MS: u32 = 15;

/// The state of the departure. `R` is the request to the bootloader.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Departure<R> {
    /// The device stays.
    #[default]
    Staying,
    /// The answer is on its way to the bus.
    Answering {
        /// The request to the bootloader.
        request: R,
        /// A master was promised this request, so another master cannot replace it.
        promised: bool,
        /// The device leaves at this time, even if frames still wait to be sent.
        latest: u32,
    },
    /// The answer is on the bus. The device serves requests during the pause after it.
    Pausing {
        /// As for [`Answering`](Self::Answering).
        request: R,
        /// As for [`Answering`](Self::Answering).
        promised: bool,
        /// As for [`Answering`](Self::Answering).
        latest: u32,
        /// The pause ends at this time.
        until: u32,
    },
    /// The device takes and sends nothing any more. The controller still sends the frames that it
    /// has.
    Silent {
        /// The request to the bootloader.
        request: R,
        /// The pause that an earlier command still needs.
        before: Before,
        /// The device leaves at this time, even if frames still wait to be sent.
        latest: u32,
    },
    /// The device is to leave now.
    Leaving {
        /// The request to the bootloader.
        request: R,
    },
}

/// The pause that a silent device still owes to a command that it answered earlier.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Before {
    /// No pause: no command was answered earlier.
    Nothing,
    /// The whole pause, which begins when the answer is on the bus.
    Pause,
    /// The rest of the pause, until this time.
    Until(u32),
}

/// What the owner has to do next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next<R> {
    /// Serve requests as usual.
    Serve,
    /// Take no request and send nothing; the frames in the mailboxes go out.
    Wait,
    /// Leave now, with this request.
    Leave(R),
}

impl<R: Copy> Departure<R> {
    /// The device took a command that this program answers. `promised`: the device is to come up in
    /// the bootloader, or the bootloader is to store something. A later command of another master
    /// that restarts the program does not replace a promised request.
    pub fn begin(&mut self, request: R, promised: bool, now: u32) {
        *self = match *self {
            Self::Staying => {
                Self::Answering { request, promised, latest: now.wrapping_add(ANSWERED_MOST_MS) }
            }
            // This answer, too, is followed by the pause.
            Self::Answering { request: before, promised: was_promised, latest }
            | Self::Pausing { request: before, promised: was_promised, latest, .. } => {
                if promised || !was_promised {
                    Self::Answering { request, promised, latest }
                } else {
                    Self::Answering { request: before, promised: was_promised, latest }
                }
            }
            // The device serves no requests any more, so there cannot be a new one.
            gone @ (Self::Silent { .. } | Self::Leaving { .. }) => gone,
        };
    }

    /// The device took a command that the bootloader is to answer. A command that was answered
    /// earlier still gets its pause.
    pub fn begin_silent(&mut self, request: R, now: u32) {
        let before = match *self {
            Self::Staying => Before::Nothing,
            Self::Answering { .. } => Before::Pause,
            Self::Pausing { until, .. } => Before::Until(until),
            Self::Silent { .. } | Self::Leaving { .. } => return,
        };
        *self = Self::Silent { request, before, latest: now.wrapping_add(SILENT_MOST_MS) };
    }

    /// Advances the departure. `bus_idle`: no answer waits to be sent, and all frames are on the
    /// bus and were acknowledged. Call it after every frame and every few milliseconds.
    pub fn proceed(&mut self, bus_idle: bool, now: u32) -> Next<R> {
        *self = self.after(bus_idle, now);
        match *self {
            Self::Staying | Self::Answering { .. } | Self::Pausing { .. } => Next::Serve,
            Self::Silent { .. } => Next::Wait,
            Self::Leaving { request } => Next::Leave(request),
        }
    }

    /// The state that follows this one.
    fn after(self, bus_idle: bool, now: u32) -> Self {
        let pause_end = now.wrapping_add(ANSWER_TO_RESET_MS);
        match self {
            Self::Answering { request, latest, .. }
            | Self::Pausing { request, latest, .. }
            | Self::Silent { request, latest, .. }
                if has_reached(now, latest) =>
            {
                Self::Leaving { request }
            }
            Self::Answering { request, promised, latest } if bus_idle => {
                Self::Pausing { request, promised, latest, until: pause_end }
            }
            Self::Pausing { request, until, .. } if bus_idle && has_reached(now, until) => {
                Self::Leaving { request }
            }
            Self::Silent { request, before: Before::Nothing, .. } if bus_idle => Self::Leaving { request },
            Self::Silent { request, before: Before::Pause, latest } if bus_idle => {
                Self::Silent { request, before: Before::Until(pause_end), latest }
            }
            Self::Silent { request, before: Before::Until(until), .. }
                if bus_idle && has_reached(now, until) =>
            {
                Self::Leaving { request }
            }
            unchanged => unchanged,
        }
    }
}

/// Whether the counter of milliseconds, which wraps, has reached `deadline`.
pub(crate) const fn has_reached(now: u32, deadline: u32) -> bool {
    now.wrapping_sub(deadline) < 1 << 31
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_pause_begins_when_the_answer_is_on_the_bus_and_requests_are_served() {
        let mut departure = Departure::Staying;
        assert_eq!(departure.proceed(true, 0), Next::Serve);
        departure.begin('b', true, 100);
        for ms in 100..130 {
            assert_eq!(departure.proceed(false, ms), Next::Serve);
        }
        assert_eq!(departure.proceed(true, 130), Next::Serve);
        assert_eq!(departure.proceed(true, 140), Next::Serve, "10 ms at least");
        assert_eq!(departure.proceed(false, 141), Next::Serve, "a frame is on its way");
        assert_eq!(departure.proceed(true, 142), Next::Leave('b'));
    }

    #[test]
    fn the_counter_of_milliseconds_may_wrap_in_between() {
        let mut departure = Departure::Staying;
        departure.begin('b', true, u32::MAX - 3);
        assert_eq!(departure.proceed(true, u32::MAX - 3), Next::Serve);
        assert_eq!(departure.proceed(true, u32::MAX), Next::Serve);
        assert_eq!(departure.proceed(true, 6), Next::Serve);
        assert_eq!(departure.proceed(true, 7), Next::Leave('b'));
    }

    /// Each answer is followed by the pause; a client that sends requests without end does not
    /// delay the departure.
    #[test]
    fn a_command_in_quick_succession_prolongs_the_pause_and_not_for_ever() {
        let mut departure = Departure::Staying;
        let mut left = None;
        for ms in 0..2000 {
            if ms % 5 == 0 {
                departure.begin('b', true, ms);
            }
            if departure.proceed(true, ms) == Next::Leave('b') {
                left = Some(ms);
                break;
            }
        }
        assert_eq!(left, Some(500));
    }

    #[test]
    fn who_was_promised_the_bootloader_gets_it() {
        let mut departure = Departure::Staying;
        departure.begin('b', true, 0);
        departure.begin('p', false, 1);
        assert_eq!(departure.proceed(true, 500), Next::Leave('b'));
        let mut departure = Departure::Staying;
        departure.begin('p', false, 0);
        departure.begin('b', true, 1);
        assert_eq!(departure.proceed(true, 500), Next::Leave('b'));
    }

    #[test]
    fn who_leaves_the_answer_to_the_bootloader_is_silent_and_leaves_at_once() {
        let mut departure = Departure::Staying;
        departure.begin_silent('o', 7);
        assert_eq!(departure.proceed(false, 7), Next::Wait, "a heartbeat is on its way");
        assert_eq!(departure.proceed(true, 8), Next::Leave('o'));
        // No node acknowledges the heartbeat.
        let mut departure = Departure::Staying;
        departure.begin_silent('o', 7);
        assert_eq!(departure.proceed(false, 21), Next::Wait);
        assert_eq!(departure.proceed(false, 22), Next::Leave('o'));
    }

    /// Two masters: the application answers the first one, which gets its 10 ms. The bootloader
    /// answers the second one, still within 25 ms.
    #[test]
    fn a_command_that_is_handed_over_keeps_the_pause_of_the_one_before() {
        let mut departure = Departure::Staying;
        departure.begin('b', true, 0);
        assert_eq!(departure.proceed(true, 0), Next::Serve);
        departure.begin_silent('o', 3);
        assert_eq!(departure.proceed(true, 10), Next::Wait);
        assert_eq!(departure.proceed(true, 11), Next::Leave('o'));
        // The earlier answer was not even on the bus.
        let mut departure = Departure::Staying;
        departure.begin('b', true, 0);
        departure.begin_silent('o', 1);
        assert_eq!(departure.proceed(true, 2), Next::Wait);
        assert_eq!(departure.proceed(true, 12), Next::Wait);
        assert_eq!(departure.proceed(true, 13), Next::Leave('o'));
    }

    #[test]
    fn a_device_that_is_silent_takes_no_other_request() {
        let mut departure = Departure::Staying;
        departure.begin_silent('o', 0);
        departure.begin('b', true, 1);
        departure.begin_silent('p', 1);
        assert_eq!(departure.proceed(true, 2), Next::Leave('o'));
        departure.begin('b', true, 3);
        assert_eq!(departure.proceed(false, 3), Next::Leave('o'));
    }

    /// A promise is kept, whatever comes after it; another promise takes its place, and a request
    /// that promised nothing gives way.
    #[test]
    fn only_a_promise_takes_the_place_of_a_promise() {
        for (first, second, leaves) in
            [(true, true, 's'), (true, false, 'f'), (false, true, 's'), (false, false, 's')]
        {
            let mut departure = Departure::Staying;
            departure.begin('f', first, 0);
            departure.begin('s', second, 1);
            departure.proceed(true, 1);
            assert_eq!(departure.proceed(true, 100), Next::Leave(leaves), "{first}, {second}");
        }
    }

    /// The bootloader answers: the device leaves when all frames are on the bus, and not before.
    #[test]
    fn a_silent_departure_waits_for_the_frames_of_an_answer_before() {
        let mut departure = Departure::Staying;
        departure.begin('f', false, 0);
        departure.begin_silent('s', 1);
        for ms in 1..3 {
            assert_eq!(departure.proceed(false, ms), Next::Wait);
        }
        // The pause of 11 ms begins when the answer is on the bus.
        assert_eq!(departure.proceed(true, 3), Next::Wait);
        assert_eq!(departure.proceed(true, 13), Next::Wait);
        assert_eq!(departure.proceed(false, 14), Next::Wait, "a frame is on its way");
        assert_eq!(departure.proceed(true, 15), Next::Leave('s'));
        // Without a bus it leaves all the same.
        let mut departure = Departure::Staying;
        departure.begin_silent('s', 0);
        assert_eq!(departure.proceed(false, 14), Next::Wait);
        assert_eq!(departure.proceed(false, 15), Next::Leave('s'));
    }

    /// Half a turn of the counter of milliseconds is the past, the other half the future.
    #[test]
    fn a_deadline_is_reached_for_half_a_turn_of_the_counter() {
        for deadline in [0, 5, u32::MAX] {
            for (later, is_reached) in
                [(0, true), (1, true), ((1 << 31) - 1, true), (1 << 31, false), (u32::MAX, false)]
            {
                assert_eq!(has_reached(deadline.wrapping_add(later), deadline), is_reached, "{later}");
            }
        }
    }
}
