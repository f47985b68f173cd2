//! What an application with a bootloader underneath does about commands of 1F51h, and how it leaves:
//! the rules, without the chip.
//!
//! [`react`] judges a command before it is answered. Where the device has to leave for it,
//! [`Departure`] tells when: the answer goes first, and what is asked meanwhile is served
//! ([`Departure::begin`]); or this program says nothing any more, and the bootloader answers in its
//! place ([`Departure::begin_silent`]).

use crate::abort::AbortCode;
use crate::program::ProgramControl;
use crate::time::Instant;

/// What an application knows of itself when a command comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Standing {
    /// It was started right behind its download in one go, and nobody has written 80h since.
    pub fresh: bool,
    /// A password came before, for a tool that wants the bootloader (CiA 814-1 clause 6.3).
    pub armed: bool,
    /// The bootloader comes up with the node-ID and bit rate in force, so that it can answer in this
    /// program's place.
    pub can_hand_over: bool,
}

/// What an application does about a command that it takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reaction {
    /// It is so already: answer.
    Nothing,
    /// Confirm this program through the callgate, then answer. It is fresh no more, whatever comes of
    /// it.
    Confirm,
    /// Answer, then leave for the bootloader.
    CallBack,
    /// Answer, then start this program anew.
    Restart,
    /// Leave at once. The bootloader carries the command out and answers.
    HandOver,
}

/// Judges a command. `own`: the sub-index is that of the program that runs.
///
/// # Errors
/// [`AbortCode::DEVICE_STATE`] for what is the bootloader's to do: it has to be called first.
pub fn react(command: ProgramControl, own: bool, standing: Standing) -> Result<Reaction, AbortCode> {
    use ProgramControl::{Clear, ClrSignature, ResetStat, SetSignature, Start, StartBootloader, Stop};

    let Standing { fresh, armed, can_hand_over } = standing;
    Ok(match command {
        // Masters that do not know SYS TEC's commands confirm by it what they have just started.
        StartBootloader if own && fresh && !armed => Reaction::Confirm,
        StartBootloader => Reaction::CallBack,
        // While a program is stopped the bootloader runs. Masters send the next request as soon as
        // they see the answer, so the answer comes from who can take that.
        Stop | Clear if can_hand_over => Reaction::HandOver,
        Stop => Reaction::CallBack,
        ResetStat if armed => Reaction::CallBack,
        // CiA 302-3 calls it "reset program", which starts it anew.
        ResetStat if own => Reaction::Restart,
        Start if own => Reaction::Nothing,
        Clear | ResetStat | Start | SetSignature | ClrSignature => return Err(AbortCode::DEVICE_STATE),
    })
}

/// How long the device stays when its answer is on the bus, in ms: at least 10 (SYS TEC manual
/// L-1112d_10, 4.5), and one that may be almost over.
pub const ANSWER_TO_RESET_MS: u32 = 11;
/// The longest that it stays after a command, in ms: a bus on which nobody acknowledges the answer
/// keeps it no longer, and neither does a client that asks without end.
pub const ANSWERED_MOST_MS: u32 = 500;
/// The longest that a command waits whose answer is left to the bootloader, in ms, for a frame that is
/// on its way. The client is to have its answer within 25.
pub const SILENT_MOST_MS: u32 = 15;

/// The way out, with what is asked of the bootloader.
#[derive(Clone, Copy, Debug)]
pub struct Departure<R>(Option<Pending<R>>);

#[derive(Clone, Copy, Debug)]
struct Pending<R> {
    request: R,
    /// A master was promised it, whatever another one asks.
    promised: bool,
    /// How long the device stays behind the last answer, in ms.
    pause_ms: u32,
    /// When the pause is over; set when the answer is on the bus.
    at: Option<Instant>,
    /// The device leaves at this time, whatever waits to be sent.
    latest: Instant,
    /// Nothing is said or served any more.
    silent: bool,
}

/// What the owner does next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Next<R> {
    /// Serve as always.
    Serve,
    /// Take no request and send nothing; the frames in the mailboxes go out.
    Wait,
    /// Leave now, with this request.
    Leave(R),
}

impl<R: Copy> Departure<R> {
    /// The device stays.
    pub const NONE: Self = Self(None);

    /// A command was taken whose answer this program sends. `promised`: the device is to come up in
    /// the bootloader, or something is to be stored. A master that was promised that is not let down
    /// by another one, whose command starts the program anew.
    pub fn begin(&mut self, request: R, promised: bool, now: Instant) {
        match &mut self.0 {
            Some(pending) => {
                if promised || !pending.promised {
                    (pending.request, pending.promised) = (request, promised);
                }
                // This answer, too, is followed by the pause.
                pending.at = None;
            }
            None => {
                let latest = now + ANSWERED_MOST_MS;
                let pause_ms = ANSWER_TO_RESET_MS;
                self.0 = Some(Pending { request, promised, pause_ms, at: None, latest, silent: false });
            }
        }
    }

    /// A command was taken whose answer is left to the bootloader. One that was answered before still
    /// has its pause.
    pub fn begin_silent(&mut self, request: R, now: Instant) {
        let latest = now + SILENT_MOST_MS;
        let new = Pending { request, promised: true, pause_ms: 0, at: None, latest, silent: true };
        self.0 = Some(match self.0 {
            Some(Pending { pause_ms, at, .. }) => Pending { pause_ms, at, ..new },
            None => new,
        });
    }

    /// Goes on with it. `quiet`: no answer waits to be sent, and everything is on the bus.
    pub fn proceed(&mut self, quiet: bool, now: Instant) -> Next<R> {
        let Some(pending) = &mut self.0 else { return Next::Serve };
        if quiet && pending.at.is_none() {
            pending.at = Some(now + pending.pause_ms);
        }
        let over = pending.at.is_some_and(|at| now.has_reached(at));
        if quiet && over || now.has_reached(pending.latest) {
            pending.silent = true;
            return Next::Leave(pending.request);
        }
        if pending.silent {
            Next::Wait
        } else {
            Next::Serve
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use Reaction::{CallBack, Confirm, HandOver, Nothing, Restart};

    const PLAIN: Standing = Standing { fresh: false, armed: false, can_hand_over: true };
    const REFUSED: Result<Reaction, AbortCode> = Err(AbortCode(0x0800_0022));

    fn reaction(value: u8, own: bool, standing: Standing) -> Result<Reaction, AbortCode> {
        react(ProgramControl::try_from(value).unwrap(), own, standing)
    }

    /// Commands by their value (SYS TEC manual L-1112d_10, table 2), of the program that runs and of
    /// another one.
    #[test]
    fn each_command_has_its_reaction() {
        for (value, own, other) in [
            (0x00, Ok(HandOver), Ok(HandOver)),
            (0x01, Ok(Nothing), REFUSED),
            (0x02, Ok(Restart), REFUSED),
            (0x03, Ok(HandOver), Ok(HandOver)),
            (0x80, Ok(CallBack), Ok(CallBack)),
            (0x83, REFUSED, REFUSED),
            (0x84, REFUSED, REFUSED),
        ] {
            assert_eq!(reaction(value, true, PLAIN), own, "{value:02X}h");
            assert_eq!(reaction(value, false, PLAIN), other, "{value:02X}h of another program");
            // A fresh program takes one of them differently, and that of its own sub-index alone.
            let fresh = Standing { fresh: true, ..PLAIN };
            let expected = if value == 0x80 { Ok(Confirm) } else { own };
            assert_eq!(reaction(value, true, fresh), expected, "{value:02X}h, fresh");
            assert_eq!(reaction(value, false, fresh), other, "{value:02X}h of another program, fresh");
        }
    }

    #[test]
    fn a_password_makes_every_way_back_one_into_the_bootloader() {
        let armed = Standing { armed: true, fresh: true, ..PLAIN };
        assert_eq!(reaction(0x80, true, armed), Ok(CallBack));
        assert_eq!(reaction(0x02, true, armed), Ok(CallBack));
        assert_eq!(reaction(0x02, false, armed), Ok(CallBack));
    }

    /// STOP is a call back then. CLEAR would be acknowledged by somebody who cannot carry it out.
    #[test]
    fn without_a_bootloader_that_answers_clear_is_refused() {
        let alone = Standing { can_hand_over: false, ..PLAIN };
        assert_eq!(reaction(0x00, true, alone), Ok(CallBack));
        assert_eq!(reaction(0x03, true, alone), REFUSED);
        assert_eq!(reaction(0x03, false, alone), REFUSED);
    }

    fn at(ms: u32) -> Instant {
        Instant::from_millis(ms)
    }

    #[test]
    fn the_pause_begins_when_the_answer_is_on_the_bus_and_requests_are_served() {
        let mut departure = Departure::NONE;
        assert_eq!(departure.proceed(true, at(0)), Next::Serve);
        departure.begin('b', true, at(100));
        for ms in 100..130 {
            assert_eq!(departure.proceed(false, at(ms)), Next::Serve);
        }
        assert_eq!(departure.proceed(true, at(130)), Next::Serve);
        assert_eq!(departure.proceed(true, at(140)), Next::Serve, "10 ms at least");
        assert_eq!(departure.proceed(false, at(141)), Next::Serve, "a frame is on its way");
        assert_eq!(departure.proceed(true, at(142)), Next::Leave('b'));
    }

    /// Each answer is followed by the pause; somebody who asks without end is not waited for.
    #[test]
    fn a_command_in_quick_succession_prolongs_the_pause_and_not_for_ever() {
        let mut departure = Departure::NONE;
        let mut left = None;
        for ms in 0..2000 {
            if ms % 5 == 0 {
                departure.begin('b', true, at(ms));
            }
            if departure.proceed(true, at(ms)) == Next::Leave('b') {
                left = Some(ms);
                break;
            }
        }
        assert_eq!(left, Some(500));
    }

    #[test]
    fn who_was_promised_the_bootloader_gets_it() {
        let mut departure = Departure::NONE;
        departure.begin('b', true, at(0));
        departure.begin('p', false, at(1));
        assert_eq!(departure.proceed(true, at(500)), Next::Leave('b'));
        let mut departure = Departure::NONE;
        departure.begin('p', false, at(0));
        departure.begin('b', true, at(1));
        assert_eq!(departure.proceed(true, at(500)), Next::Leave('b'));
    }

    #[test]
    fn who_leaves_the_answer_to_the_bootloader_is_silent_and_leaves_at_once() {
        let mut departure = Departure::NONE;
        departure.begin_silent('o', at(7));
        assert_eq!(departure.proceed(false, at(7)), Next::Wait, "a heartbeat is on its way");
        assert_eq!(departure.proceed(true, at(8)), Next::Leave('o'));
        // Nobody acknowledges the heartbeat.
        let mut departure = Departure::NONE;
        departure.begin_silent('o', at(7));
        assert_eq!(departure.proceed(false, at(21)), Next::Wait);
        assert_eq!(departure.proceed(false, at(22)), Next::Leave('o'));
    }

    /// Two masters: the first was answered, and has its 10 ms; the second is answered by the
    /// bootloader, within 25 ms still.
    #[test]
    fn a_command_that_is_handed_over_keeps_the_pause_of_the_one_before() {
        let mut departure = Departure::NONE;
        departure.begin('b', true, at(0));
        assert_eq!(departure.proceed(true, at(0)), Next::Serve);
        departure.begin_silent('o', at(3));
        assert_eq!(departure.proceed(true, at(10)), Next::Wait);
        assert_eq!(departure.proceed(true, at(11)), Next::Leave('o'));
    }
}
