//! Advice in the words of the engineer's page, which names its own buttons and fields.

use std::fmt::Display;

use coboot_can::AdapterError;
use coflash_core::advice::Advice;
use coflash_core::file::FileError;

/// What to do next. What names nothing of the command line is the same on the page.
pub(super) fn on_page(advice: &Advice) -> String {
    let words = match advice {
        Advice::NoAdapter { words } => {
            return format!("{words}; the list in the part Adapter has the adapters of this computer")
        }
        Advice::Url { words } => {
            return format!("{words} in the part Adapter, whose list has the adapters of this computer")
        }
        Advice::Continue => "do the same again to continue",
        Advice::Reach { node } => {
            return format!(
                "check that node {node} is the right one, that the device has power, that both sides use the same bit \
                 rate and that the bus is terminated"
            )
        }
        Advice::InvalidAnswer => "look for a second tool or a second device with this node-ID on the bus",
        Advice::CallBootloader => {
            "the bootloader has this object, and its application need not have it: More … at the device calls the \
             bootloader; one without support for sealed images has none"
        }
        Advice::OtherDialect => "the device cannot do this",
        Advice::GivePassword => "enter the device's password beside the button Update; its manufacturer knows it",
        Advice::NeedsNoPassword => "the device has no password: leave the field empty",
        Advice::Occupied { node } => {
            return format!(
                "finish the update of the device that is node {node} now, or switch that device off; then try again"
            )
        }
        Advice::NotAlone => "wait until the other tool has finished, or end it; then try again",
        Advice::NoProgramNumber => "the device has no such program: check the field Program",
        Advice::SmallerBlocks => {
            "the block may be larger than the bootloader's buffer: choose the firmware file that the block file was made of"
        }
        Advice::LostFrames => {
            "frames were lost, or a second tool is at work on the device: check the bus and try again"
        }
        Advice::Refused => "try again; if it happens again, the abort code gives the device's reason",
        Advice::NoDebugger => "the device has no debugger interface; no product has one (docs/debugger.md)",
        Advice::OtherCrc => {
            "the device finds a wrong CRC in a block that has arrived whole: another tool writes to it, too; end that tool, \
             and try again"
        }
        Advice::ClearFirst { program } => {
            return format!(
                "clear that program first, and install it again afterwards: choose {program} in the field Program, and erase \
                 it with More … at the device"
            )
        }
        Advice::OtherBootloader => {
            "the file is a bootloader for another board, for a newer resident part, or not the one of this product: \
             More … at the device shows what it has"
        }
        Advice::Supply => {
            "check the supply of the device under load, from its source to the chip (More … at the device says whether \
             it is good), and try again"
        }
        Advice::FirstFailed { first } => return format!("find out why node {first} has failed, and try again"),
        Advice::RenewalFailed => {
            "nothing is lost: look whether the file is the bootloader of this product and of its bit rate, and try \
             again; More … at the device has the cause of a reset that nobody asked for"
        }
        Advice::SilentOnTrial => {
            "nothing is lost: the old bootloader comes back by itself at the end of the trial \
             (renewal.confirm_within_s of the product, 60 s if it has no other), or at once when the device is switched off and on"
        }
        Advice::Seal => {
            "seal the program with a key that a root of the device has certified, and choose the sealed image"
        }
        Advice::OtherRegion => "link the program for that address, or check the fields Board and Program",
        Advice::OtherIdentity => {
            "check that the program was made for this device: it is not released for autostart; one that has an identity \
             of its own is updated without Trial run first"
        }
        Advice::StaysBusy => "switch the device off and on, and try again",
        Advice::BootloaderElsewhere { other } => {
            return format!(
                "if node {other} is this device (More … in its row), its bootloader has another node-ID than its \
                 application: search the bus, and choose node {other}"
            )
        }
        Advice::RefusesNow { .. } => {
            "the application refuses now: stop the machine and try again. If it refuses for ever, switch the device off and \
             on and try again at once: after a refusal the next start has a rescue window; the entry strap helps, too"
        }
        Advice::UnknownCall => {
            "this application does not know the call (1F51h = 80h): bring the device into the bootloader by its entry strap, \
             or within its rescue window after power-on"
        }
        Advice::Catch => {
            "switch the device off and on and try again at once; its entry strap holds it in the bootloader, too"
        }
        Advice::LssAddress => {
            "check the four numbers of the address (More … at the device can enter them), and that the device has power"
        }
        Advice::AssignNode => "give the device a node-ID in the part Node-ID and bit rate",
        Advice::WrongCrc => "check that the file was made for this board and this program number, and try again",
        Advice::TrialElsewhere { other } => {
            return format!(
                "{}; one that is to keep its own is updated without Trial run first",
                elsewhere(*other)
            )
        }
        Advice::ProgramElsewhere { other } => return elsewhere(*other),
        Advice::TrialSilent { .. } => {
            "switch the device off and on: it comes up in the bootloader, ready for another program; the program may crash \
             or have a wrong bit rate; one that answers under another node-ID than its bootloader is updated without \
             Trial run first"
        }
        Advice::GiveWayBack { .. } => {
            "give the program 1F51h = 80h, the way back into the bootloader (docs/application.md): without it the device \
             can never be updated over the bus. Switch the device off and on: it comes up in the bootloader, ready for \
             another program"
        }
        Advice::ProgramSilent { .. } => {
            "the program may not speak CANopen, use another node-ID or bit rate, or crash: switch the device off and on, and \
             update it with another one at once; if that does not succeed, use its entry strap"
        }
        Advice::FlashFirst => "update the device first: it has no program",
        Advice::FlashAgain => {
            "update the device again: what is in the flash is not what was sent; if it happens again, the flash is worn out"
        }
        Advice::NodeIdForProduct => {
            "give the device a node-ID in the range of its product (the part Node-ID and bit rate); the program stays as it is"
        }
        Advice::FeedWatchdog => {
            "the program does not feed its watchdog in time: feed it from its first instructions on (docs/application.md)"
        }
        Advice::ResetsItself => {
            "the program resets itself, as the handler of a panic or a fault does: read its log, or run it under a debugger"
        }
        Advice::Standby => "the program put the device into Standby, and it woke up",
        Advice::EndsItself => {
            "the program ends by itself: read its log, or run it under a debugger; More … at the device says why it stays in \
             the bootloader"
        }
        Advice::NoValidProgram => "update the device: it has no program that may start",
        Advice::WrongFormat => {
            "check that the file is for this bootloader and this board: with the board in the field Board, Contents of the \
             file says whether its stack and its reset vector are those of a program there"
        }
        Advice::CheckBus => "try again; if it happens again, check bus and terminators",
        Advice::NotCleared => "update the device, which erases first; another tool may be at work on it",
        Advice::WriteFailed => "try again; if it happens again, the flash may be worn out or write-protected",
        Advice::OtherMap => "the file is for another memory map: check the fields Board and Program",
        Advice::NvData => "try again; if it happens again, the device cannot store its parameters",
        Advice::OtherProduct => {
            "check that file and device belong together (More … at the device shows its identity)"
        }
        Advice::NoAccess => {
            "the device forbids this at present. If it is sealed (More … at the device says so), it takes sealed images \
             alone, and other changes only with a right, which the signature of a root gives; otherwise ask its \
             manufacturer what allows it"
        }
        Advice::WaitABit => "wait a moment and try again; another tool may be at work on the device",
        Advice::BadSignature => {
            "check the file with the root's public key; seal the program again with a key that the device's root has certified"
        }
        Advice::Rollback => {
            "compare counter and epoch in Contents of the file with those that the device takes, in More … at the device: an \
             old program is sealed again with a higher counter, and in place of an old key sign with the one that is \
             valid now"
        }
        Advice::OtherKey => {
            "compare the key ids in Contents of the file with those that the device was provisioned with; programs that are \
             signed for tests run on devices for tests alone"
        }
        Advice::Sequence => "try again; another tool may be at work on the device",
        Advice::OnceMore => "try again, or switch the device off and on first",
        Advice::Provision => {
            "write keys into the device with a debug probe, or choose the program as it is, not sealed"
        }
        Advice::OneDownload => "the device takes this sealed image in one download alone, which this page cannot choose",
        Advice::BootloaderFile => {
            "choose the program, linked for an address after the bootloader; the page renews a bootloader whose RAM image has \
             a header, and a debug probe writes any other"
        }
        Advice::OtherPlace => {
            "let FLASH begin at that address in the linker script, or check the fields Board and Program"
        }
        Advice::StackOverHandoff => {
            "let RAM end before the handoff in the linker script: 64 bytes less than the chip has (LENGTH = 128K - 64), so that \
             _estack or _stack_start is at most the handoff's address"
        }
        Advice::ResetVector => {
            "check that it is the right file, and that it is linked for this address (the fields Board and Program)"
        }
        Advice::VectorTable => {
            "give the vector table its whole length, one vector for each interrupt of the chip, and let the linker script place \
             the code after it"
        }
        Advice::NoVectorTable => "check that it is the right file, and that it begins with the vector table",
        Advice::AreaAlias => {
            "link the program for the flash, which begins at 08000000h; S1 and S2 records have no room for such an address: \
             write S3 records"
        }
        Advice::AreaOptionBytes => {
            "a bootloader does not write them: leave the section out of the file, and set option bytes with a debug probe"
        }
        Advice::AreaOtp => {
            "a bootloader does not write it: leave the section out of the file, and write it with a debug probe"
        }
        Advice::AreaReserved => "check that the file is for an STM32F4; if it is, leave the section out of it",
        Advice::AreaExternal => {
            "the bootloader writes the chip's own flash alone: leave the section out of the file, and let the program or a \
             debug probe write it"
        }
        Advice::GiveSealed => "choose a sealed image",
        Advice::SealedByOther => "seal the program again, with the tool that belongs to the bootloader",
        Advice::SealedForChip => "seal the program for this device, or for all of the product",
        Advice::SealedForRevision => "seal the program for this revision, if it supports that revision",
        Advice::Smaller => "make the program smaller: compression makes the file smaller, not the program",
        Advice::HigherCounter => {
            "seal the program with a higher security counter, if it is to replace the newer one"
        }
        Advice::Certify => "have the key certified for this program",
        Advice::GiveRoot => "seal it with a certificate of a root that the device has",
        Advice::ReleaseKey => "sign it with a release key",
        Advice::GiveKek => "encrypt it for a key of the device",
        Advice::GiveBase => "choose the image that was sealed without a base",
        Advice::RawNeedsAddress => "a raw binary needs a board",
        Advice::SealedStays => "choose it without a change",
        Advice::GiveAddress => "choose the board",
        Advice::SelectRange => "leave what is not of the program out of the file",
        Advice::KnowBoard => "the field Board says whether yours is one",
        Advice::RenewsDevice => "the button Update renews that of a device",
        Advice::IsRefused => "an update refuses it",
        Advice::ReleaseIt => {
            "More … at the device has Start the program, which tries it, and Release for autostart"
        }
        Advice::StartIt => "Start the program, in More … at the device, starts it again",
        Advice::ConfirmIt => "an update with its file confirms it",
        same => return same.to_string(),
    };
    words.to_string()
}

/// The advice for a program that may have come up as another node.
fn elsewhere(other: impl Display) -> String {
    format!(
        "if node {other} is this device (More … in its row), its program has another node-ID than its bootloader: let it take \
         that of the handoff (docs/application.md)"
    )
}

/// A text of the library that has this advice in it, in the words of the page.
pub(super) fn with_advice(text: impl Display, advice: impl IntoIterator<Item = Advice>) -> String {
    let word = |text: String, advice: Advice| text.replace(&advice.to_string(), &on_page(&advice));
    advice.into_iter().fold(text.to_string(), word)
}

/// The fault of a file.
pub(super) fn of_file(error: &FileError) -> String {
    with_advice(error, error.error.cause.advice())
}

/// What to do about an adapter.
pub(super) fn of_adapter(error: &AdapterError) -> String {
    on_page(&error.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What only the command line has: options, commands, and what is to be typed.
    fn is_of_command_line(words: &str) -> bool {
        let mut before = "";
        let command = words.split_whitespace().any(|word| {
            let is_command = before == "coflash" && word.starts_with(|c: char| c.is_ascii_lowercase());
            before = word.trim_start_matches('(');
            is_command
        });
        command || words.contains("--") || words.contains('`') || words.contains("the command")
    }

    #[test]
    fn no_advice_of_the_page_names_the_command_line() {
        let all = Advice::samples();
        assert!(all.iter().filter(|advice| is_of_command_line(&advice.to_string())).count() > 50);
        for advice in all {
            let words = on_page(&advice);
            assert!(!words.is_empty() && !is_of_command_line(&words), "{advice:?}: {words}");
        }
    }

    #[test]
    fn a_text_with_advice_gets_the_words_of_the_page() {
        let text = format!("it waits: {}", Advice::StartIt);
        assert!(is_of_command_line(&text));
        let words = with_advice(text, Some(Advice::StartIt));
        assert_eq!(words, "it waits: Start the program, in More … at the device, starts it again");
        assert_eq!(with_advice("it waits", None), "it waits");
    }
}
