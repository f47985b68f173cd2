//! The rule that says how an application reacts to a command of 1F51h. It has no state and does
//! not use the chip.

use crate::abort::Abort;

/// A command, written to 1F51h (CiA 302-3; SYS TEC manual L-1112d_10, table 2).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Command {
    /// Stop the program.
    Stop = 0x00,
    /// Start the program.
    Start = 0x01,
    /// Reset the program (CiA 302-3).
    Reset = 0x02,
    /// Erase the program.
    Clear = 0x03,
    /// Go back from the application to the bootloader.
    StartBootloader = 0x80,
    /// Mark the program as valid, so that it starts by itself.
    SetSignature = 0x83,
    /// Mark the program as not valid.
    ClearSignature = 0x84,
}

impl Command {
    /// The command of this value.
    #[must_use]
    pub const fn from_value(value: u8) -> Option<Self> {
        Some(match value {
            0x00 => Self::Stop,
            0x01 => Self::Start,
            0x02 => Self::Reset,
            0x03 => Self::Clear,
            0x80 => Self::StartBootloader,
            0x83 => Self::SetSignature,
            0x84 => Self::ClearSignature,
            _ => return None,
        })
    }
}

/// The state of an application when a command comes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct State {
    /// It was started right after its download in one sequence, and no master has written 80h
    /// since.
    pub fresh: bool,
    /// A password came before, for a tool that wants the bootloader (CiA 814-1 clause 6.3).
    pub armed: bool,
    /// The bootloader comes up with the node-ID and bit rate in force, so that it can answer in this
    /// program's place.
    pub can_hand_over: bool,
}

/// The reaction of an application to a command that it accepts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reaction {
    /// The command changes nothing: answer.
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
/// [`Abort::DEVICE_STATE`] for what is the bootloader's to do: it has to be called first.
pub const fn react(command: Command, own: bool, state: State) -> Result<Reaction, Abort> {
    use Command::{Clear, ClearSignature, Reset, SetSignature, Start, StartBootloader, Stop};

    let State { fresh, armed, can_hand_over } = state;
    Ok(match command {
        // Masters that do not know SYS TEC's commands confirm by it what they have just started.
        StartBootloader if own && fresh && !armed => Reaction::Confirm,
        StartBootloader => Reaction::CallBack,
        // While a program is stopped the bootloader runs. Masters send the next request as soon as
        // they see the answer, so the answer comes from who can take that.
        Stop | Clear if can_hand_over => Reaction::HandOver,
        Stop => Reaction::CallBack,
        Reset if armed => Reaction::CallBack,
        // CiA 302-3 calls it "reset program", which starts it anew.
        Reset if own => Reaction::Restart,
        Start if own => Reaction::Nothing,
        Clear | Reset | Start | SetSignature | ClearSignature => return Err(Abort::DEVICE_STATE),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use Reaction::{CallBack, Confirm, HandOver, Nothing, Restart};

    const PLAIN: State = State { fresh: false, armed: false, can_hand_over: true };
    const REFUSED: Result<Reaction, Abort> = Err(Abort(0x0800_0022));

    fn reaction(value: u8, own: bool, state: State) -> Result<Reaction, Abort> {
        react(Command::from_value(value).unwrap(), own, state)
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
            let fresh = State { fresh: true, ..PLAIN };
            let expected = if value == 0x80 { Ok(Confirm) } else { own };
            assert_eq!(reaction(value, true, fresh), expected, "{value:02X}h, fresh");
            assert_eq!(reaction(value, false, fresh), other, "{value:02X}h of another program, fresh");
        }
    }

    #[test]
    fn a_password_makes_every_way_back_one_into_the_bootloader() {
        let armed = State { armed: true, fresh: true, ..PLAIN };
        assert_eq!(reaction(0x80, true, armed), Ok(CallBack));
        assert_eq!(reaction(0x02, true, armed), Ok(CallBack));
        assert_eq!(reaction(0x02, false, armed), Ok(CallBack));
    }

    /// STOP is a call back then. CLEAR would be acknowledged by somebody who cannot carry it out.
    #[test]
    fn without_a_bootloader_that_answers_clear_is_refused() {
        let alone = State { can_hand_over: false, ..PLAIN };
        assert_eq!(reaction(0x00, true, alone), Ok(CallBack));
        assert_eq!(reaction(0x03, true, alone), REFUSED);
        assert_eq!(reaction(0x03, false, alone), REFUSED);
    }

    /// The commands are those of the stack of this repository.
    #[test]
    fn a_value_is_a_command_where_the_standard_or_the_manual_has_it() {
        for value in 0..=u8::MAX {
            let known = canopen::program::ProgramControl::try_from(value).is_ok();
            assert_eq!(Command::from_value(value).map(|command| command as u8), known.then_some(value));
        }
    }
}
