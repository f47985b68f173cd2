//! What to do next: every piece of advice of coflash, once, in the words of each front.
//!
//! The command line names its commands and options, the engineer's page its buttons and fields. Where they
//! differ, a sentence has both: `[words of the command line|words of the page]`.

use std::fmt::{self, Display};

use canopen::NodeId;

/// Who says the advice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Front {
    /// The command line.
    Terminal,
    /// The engineer's page.
    Page,
}

/// The number of a program in a sentence, which says nothing of the first one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct OfProgram(pub u8);

/// What a sentence names, in the words of a front.
trait Named {
    fn named(&self, front: Front) -> String;
}

impl<T: Display> Named for T {
    fn named(&self, _: Front) -> String {
        self.to_string()
    }
}

impl Named for OfProgram {
    fn named(&self, front: Front) -> String {
        match front {
            _ if self.0 == 1 => String::new(),
            Front::Terminal => format!(" --program {}", self.0),
            Front::Page => format!(" with {} in the field Program", self.0),
        }
    }
}

/// Defines [`Advice`] by a table: what each one is for, and its sentence.
macro_rules! advice {
    ($($(#[$doc:meta])+ $name:ident $({ $field:ident: $kind:ty })? => $sentence:literal,)+) => {
        /// What to do next. `Display` has the words of the command line.
        #[derive(Clone, Debug, PartialEq, Eq)]
        #[non_exhaustive]
        pub enum Advice {
            $($(#[$doc])+ $name $({
                /// What the sentence names.
                $field: $kind
            })?,)+
        }

        impl Advice {
            /// The sentence in the words of this front.
            #[must_use]
            pub fn words(&self, front: Front) -> String {
                match self {
                    $(Self::$name $({ $field })? => {
                        let words = of_front($sentence, front);
                        $(let words = words.replace(concat!("{", stringify!($field), "}"), &$field.named(front));)?
                        words
                    })+
                }
            }
        }

        /// Each name with its placeholder and its sentence.
        #[cfg(test)]
        const TABLE: &[(&str, &str, &str)] =
            &[$((stringify!($name), concat!("", $("{", stringify!($field), "}")?), $sentence)),+];
    };
}

/// The words of this front from a sentence with those of both.
fn of_front(sentence: &str, front: Front) -> String {
    let mut words = String::new();
    let mut rest = sentence;
    while let Some((both, choice)) = rest.split_once('[') {
        let (terminal, choice) = choice.split_once('|').unwrap_or_default();
        let (page, after) = choice.split_once(']').unwrap_or_default();
        words += both;
        words += if front == Front::Terminal { terminal } else { page };
        rest = after;
    }
    words + rest
}

impl Display for Advice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.words(Front::Terminal))
    }
}

advice! {
    /// For an adapter that fails.
    Adapter { words: String } => "{words}",
    /// For an adapter that is not there.
    NoAdapter { words: String } => "{words}; [coflash adapters lists|the list in the part Adapter has] the \
        adapters of this computer",
    /// For a URL of a bus that is wrong.
    Url { words: String } => "{words}[ (--bus or COFLASH_BUS); coflash adapters lists| in the part Adapter, \
        whose list has] the adapters of this computer",
    /// After a cancellation.
    Continue => "[run the same command|do the same] again to continue",
    /// For a device that does not answer.
    Reach { node: NodeId } => "check that node {node} is the right one, that the device has power, that both \
        sides use the same bit rate and that the bus is terminated[; a slow device may need a longer \
        --sdo-timeout|]",
    /// For answers that are too short for SDO.
    ShortAnswer => "SDO frames have 8 bytes (CiA 301 clause 7.2.4.3): look for a setting of the device that \
        fills them up, or ask its manufacturer",
    /// For an answer that is invalid.
    InvalidAnswer => "look for a second tool or a second device with this node-ID on the bus[; a longer \
        --sdo-timeout helps against answers that come late|]",
    /// For an object that only the bootloader has.
    CallBootloader => "the bootloader has this object, and its application need not have it: [coflash \
        enter|More … at the device] calls the bootloader; one without support for sealed images has none",
    /// For a release while the program runs.
    EnterFirst => "its program runs, and only the bootloader changes the release: call the bootloader [(coflash \
        enter)|(More … at the device)], [run the command|try] again, and start the program then[ (coflash start)|]",
    /// For an option that the dialect does not have.
    OtherDialect => "[leave out this option, or name another dialect with --dialect|the device cannot do this]",
    /// For a locked device.
    GivePassword => "[give the device's password with --unlock|enter the device's password beside the button \
        Update]; its manufacturer knows it",
    /// For a password where the device has none.
    NeedsNoPassword => "the device has no password: [check --dialect, or leave out --unlock|leave the field empty]",
    /// After several wrong passwords.
    PasswordLater => "after a wrong password a device accepts none for a while: try the right one in half a minute",
    /// For a wrong password.
    WrongPassword => "check the password: the device's manufacturer knows it; after wrong passwords the \
        device may accept none for a while",
    /// For a node-ID that another device has.
    Occupied { node: NodeId } => "finish the update of the device that is node {node} now, or switch that \
        device off; then [run the command|try] again",
    /// For a node-ID that two devices have.
    TwoDevices { node: NodeId } => "a second device answers as node {node}, too: switch one of them off, or give \
        one another node-ID[ (coflash lss)|]",
    /// While another tool uses the device.
    NotAlone => "wait until the other tool has finished, or end it; then [run the command|try] again[; \
        coflash flash --not-alone goes on all the same, at the risk that both fail|]",
    /// For a device without the object.
    NoObject => "the device has no such object: is it a device with this bootloader?",
    /// For a program number that the device does not have.
    NoProgramNumber => "the device has no such program: check [--program|the field Program]",
    /// For a block that the device does not take.
    SmallerBlocks => "the block may be larger than the bootloader's buffer: [convert with a smaller \
        --block-size|choose the firmware file that the block file was made of]",
    /// For frames that were lost.
    LostFrames => "frames were lost, or a second tool is at work on the device: check the bus and [run the \
        command|try] again",
    /// For any other refusal.
    Refused => "[run the command|try] again; if it happens again, the abort code gives the device's reason",
    /// For a device without the debugger interface.
    NoDebugger => "the device has no debugger interface; no product has one[; on the bench, build its \
        firmware with the feature `debugger`|] (docs/debugger.md)",
    /// For bytes that the debugger interface does not access.
    NoAccessToBytes => "these bytes cannot be accessed: there is no memory, or the write is to flash, or it \
        covers part of a register (docs/debugger.md)",
    /// For a chip with read-out protection.
    ReadOutProtected => "the device is secured: its read-out protection (RDP) has to be taken away first, \
        which erases it",
    /// While the flash is erased.
    FlashBusy => "the flash is busy: try again when the erase has ended",
    /// For a device that checks with the other CRC.
    OtherCrc => "the device finds a wrong CRC in a block that has arrived whole: [it checks with the other \
        CRC, or |]another tool writes to it, too[. Each repeat of block 0 has the other CRC: leave out \
        --block-repeats 0, or give --crc16 for a product with CRC-16; then end the other tool|; end that \
        tool, and try again]",
    /// For a sector with write protection.
    Unprotect { sector: u16 } => "take the write protection of sector {sector} away with a debug probe \
        (option bytes: nWRP, SPRMOD), and look whether the installed program sets it; nothing of that \
        program is lost",
    /// For a program that reaches into staging.
    ClearFirst { program: u16 } => "clear that program first, and install it again afterwards: [coflash \
        erase --program {program}|choose {program} in the field Program, and erase it with More … at the \
        device]",
    /// For a bootloader that does not fit the device.
    OtherBootloader => "the file is a bootloader for another board, for a newer resident part, or not the \
        one of this product: [coflash info shows what the device has; give the bootloader of its product \
        that was built for its resident part (`resident`)|More … at the device shows what it has]",
    /// For a supply that is too low.
    Supply => "check the supply of the device under load, from its source to the chip ([coflash info|More … \
        at the device] says whether it is good), and [run the command|try] again",
    /// For a bootloader that cannot be renewed over the bus.
    NotRenewable => "write it with a debug probe; a product with renewal needs a layout with staging \
        (docs/renewal.md)",
    /// For a bootloader without renewal.
    Unconfirmable => "build the bootloader for a product with renewal (docs/renewal.md): it could not be \
        renewed again",
    /// After the failure of the first renewal of several.
    FirstFailed { first: NodeId } => "find out why node {first} has failed, and [run the command|try] again",
    /// After a trial of a bootloader that failed.
    RenewalFailed => "nothing is lost: look whether the file is the bootloader of this product and of its \
        bit rate, and [run the command again; a reset that nobody asked for has its cause in coflash \
        info|try again; More … at the device has the cause of a reset that nobody asked for]",
    /// For a bootloader on trial that does not answer.
    SilentOnTrial => "nothing is lost: the old bootloader comes back by itself at the end of the trial \
        (renewal.confirm_within_s of the product, 60 s if it has no other), or at once when the device is \
        switched off and on[; for a product with a longer time give that time and 15 s more, in ms, as \
        --boot-timeout|]",
    /// For a device that takes sealed images alone.
    Seal => "seal the program with a key that a root of the device has certified[ (coflash seal image)|], and \
        [flash|choose] the sealed image",
    /// For a program that is linked for another address.
    OtherRegion => "link the program for that address, or check [--program and --board; --force leaves that \
        to the device|the fields Board and Program]",
    /// For a program with another identity than its bootloader.
    OtherIdentity => "check that the program was made for this device: it is not released for autostart; one \
        that has an identity of its own is [flashed with --no-trial|updated without Trial run first]",
    /// For a device that stays busy.
    StaysBusy => "[give it more time with --command-timeout, or |]switch the device off and on[|, and try again]",
    /// For a bootloader that may have come up as another node.
    BootloaderElsewhere { other: NodeId } => "if node {other} is this device ([coflash info --node \
        {other}|More … in its row]), its bootloader has another node-ID than its application: [run the \
        command again with --node {other}|search the bus, and choose node {other}]",
    /// For an application that refuses to leave in its present state.
    RefusesNow { node: NodeId } => "the application refuses now: stop the machine and [run the command|try] \
        again. If it refuses for ever, [run coflash more catch --node {node} and |]switch the device off and on[| \
        and try again at once]: after a refusal the next start has a rescue window[ (with a sealed program \
        after coflash reset --node {node} alone)|]; the entry strap helps, too",
    /// For an application that does not know the call.
    UnknownCall => "this application does not know the call (1F51h = 80h): [--dialect raw stops it by 1F51h \
        = 0; otherwise |]bring the device into the bootloader by its entry strap, or within its rescue \
        window after power-on",
    /// For an application that has no way back.
    NoCallBack => "this application cannot be called back: bring the device into the bootloader by its entry \
        strap, or within its rescue window after power-on",
    /// For a device that does not come back as bootloader.
    Catch => "switch the device off and on and [run the command again; if its application ignores the call, \
        coflash more catch holds the device in the bootloader while it is switched off and on (rescue window), \
        and so does the entry strap|try again at once; its entry strap holds it in the bootloader, too]",
    /// For a search by LSS that ends without an answer.
    FastscanAgain => "run it again; if it happens again, two devices may have one LSS address",
    /// For an LSS address that no device has.
    LssAddress => "check the four numbers of the address ([coflash info shows them as identity|More … at the \
        device can enter them]), and that the device has power",
    /// For any other silence in LSS.
    LssSilence => "check that the device supports LSS, that it has power, and that both sides use the same \
        bit rate",
    /// For a device without a node-ID.
    AssignNode => "[give the node-ID for the device, or set it with coflash lss assign|give the device a \
        node-ID in the part Node-ID and bit rate]",
    /// For a device that cannot store by LSS.
    NoStorage => "this device cannot store node-ID and bit rate: its switches or its application set them",
    /// For a device that has not stored by LSS.
    BrokenStorage => "run it again; if it happens again, the device's memory is broken",
    /// For a bit rate that the device does not have.
    OtherBitRate => "choose a bit rate that the device supports",
    /// For a node-ID that the device does not take.
    OtherNodeId => "choose a node-ID from 1 to 127",
    /// For another CRC in the device than in the file.
    WrongCrc => "check that the file was made for this board and this program number, and [run the \
        command|try] again",
    /// For a program on trial that may have come up as another node.
    TrialElsewhere { other: NodeId } => "if node {other} is this device ([coflash info --node {other}|More … \
        in its row]), its program has another node-ID than its bootloader: let it take that of the handoff \
        (docs/application.md); one that is to keep its own is [flashed with --no-trial|updated without Trial \
        run first]",
    /// For a program on trial that does not answer.
    TrialSilent { node: NodeId } => "switch the device off and on: it comes up in the bootloader, ready for \
        another program[ (coflash more catch --node {node} waits for it)|]; the program may crash or have a wrong \
        bit rate; [for one that answers under another node-ID than its bootloader there is --no-trial|one \
        that answers under another node-ID than its bootloader is updated without Trial run first]",
    /// For an adapter that failed while a program was tried.
    NoVerdict => "the program may be right: check the supply of the adapter, its cable and the USB hub, then \
        [run the command|update the device] again; over UART without CAN, the device itself is the adapter",
    /// For a program on trial that does not return.
    GiveWayBack { node: NodeId } => "give the program 1F51h = 80h, the way back into the bootloader \
        (docs/application.md): without it the device can never be updated over the bus. [Reset the device \
        (coflash reset --node {node}), or switch it|Switch the device] off and on: it comes up in the \
        bootloader, ready for another program[ (coflash more catch --node {node} waits for it)|]",
    /// For a program that may have come up as another node.
    ProgramElsewhere { other: NodeId } => "if node {other} is this device ([coflash info --node {other}|More \
        … in its row]), its program has another node-ID than its bootloader: let it take that of the handoff \
        (docs/application.md)",
    /// For a program that does not answer after its start.
    ProgramSilent { node: NodeId } => "the program may not speak CANopen, use another node-ID or bit rate, \
        or crash: [run coflash more catch --node {node}, |]switch the device off and on, and [flash another one; \
        if it is not caught|update it with another one at once; if that does not succeed], use its entry \
        strap",
    /// For a device without a program.
    FlashFirst => "[flash a program first (coflash flash): the device has none|update the device first: it \
        has no program]",
    /// For a program that is damaged in the flash.
    FlashAgain => "[flash the program|update the device] again: what is in the flash is not what was sent; \
        if it happens again, the flash is worn out",
    /// For a device that waits for its node-ID.
    NodeIdForProduct => "give the device a node-ID in the range of its product ([coflash lss assign|the part \
        Node-ID and bit rate]); the program stays as it is",
    /// For a start that the product forbids.
    StartForbidden => "the product forbids the start at present: ask its manufacturer what allows it; the \
        program stays as it is",
    /// For a program that does not start for an unknown reason.
    NotStarted => "check that the program was linked for this board and program number; the device waits in \
        the bootloader for another one",
    /// For a program that a watchdog has ended.
    FeedWatchdog => "the program does not feed its watchdog in time: feed it from its first instructions on \
        (docs/application.md)[, or watch it for as long as it needs with --watch; --watch 0 does not watch|]",
    /// For a program that resets itself.
    ResetsItself => "the program resets itself, as the handler of a panic or a fault does: read its log, or \
        run it under a debugger[; a program that restarts on purpose is flashed with --watch 0|]",
    /// For a device that has lost its power.
    PowerLost => "check the supply of the device: it lost its power while the program ran",
    /// For a program that goes to Standby.
    Standby => "the program put the device into Standby, and it woke up[: a program that does so on purpose \
        is flashed with --watch 0|]",
    /// For a program that ends for an unknown reason.
    EndsItself => "the program ends by itself: read its log, or run it under a debugger; [coflash info says \
        why the device|More … at the device says why it] stays in the bootloader[; a program that restarts \
        on purpose is flashed with --watch 0|]",
    /// For 1F57h: no valid program.
    NoValidProgram => "[flash a program, and release it for autostart|update the device: it has no program \
        that may start]",
    /// For 1F57h: the format.
    WrongFormat => "check that the file is for this bootloader and this board: [coflash inspect --board|with \
        the board in the field Board, Contents of the file] says whether its stack and its reset vector are \
        those of a program there",
    /// For 1F57h: a CRC.
    CheckBus => "[run the command|try] again; if it happens again, check bus and terminators",
    /// For 1F57h: not cleared.
    NotCleared => "[run the flash command|update the device], which erases first; another tool may be at \
        work on [the device|it]",
    /// For 1F57h: a write.
    WriteFailed => "[run the command|try] again; if it happens again, the flash may be worn out or write-protected",
    /// For 1F57h: an address.
    OtherMap => "the file is for another memory map: check [--board and --program|the fields Board and Program]",
    /// For 1F57h: secured.
    Secured => "the file wants to write into the bootloader: check how the program is linked; if it is \
        linked right, the flash is write-protected by its option bytes",
    /// For 1F57h: parameters that cannot be stored.
    NvData => "[run the command|try] again; if it happens again, the device cannot store its parameters",
    /// For a file of another product.
    OtherProduct => "check that file and device belong together ([coflash info shows the device's \
        identity|More … at the device shows its identity])",
    /// For 1F57h: no access.
    NoAccess => "the device forbids this at present. If it is sealed ([coflash info|More … at the device] \
        says so), it takes sealed images alone[ (coflash seal image)|], and other changes only with a right, which \
        the signature of a root gives[ (coflash seal unlock)|]; otherwise ask its manufacturer what allows it",
    /// For 1F57h: busy.
    WaitABit => "wait a moment and [run the command|try] again; another tool may be at work on the device",
    /// For 1F57h: a signature.
    BadSignature => "check the file with [coflash seal verify and |]the root's public key; seal the program again \
        with a key that the device's root has certified",
    /// For 1F57h: an old image.
    Rollback => "compare counter and epoch in [coflash seal show|Contents of the file] with those that the device \
        takes, in [coflash info|More … at the device]: an old program is sealed again with a higher \
        [--counter|counter], and in place of an old key sign with the one that is valid now",
    /// For 1F57h: a key.
    OtherKey => "compare the key ids [that coflash seal show prints|in Contents of the file] with those that the \
        device was provisioned with; programs that are signed for tests run on devices for tests alone",
    /// For 1F57h: the sequence.
    Sequence => "[run the command|try] again; another tool may be at work on the device",
    /// For any other value of 1F57h.
    OnceMore => "[run the command|try] again, or switch the device off and on first",
    /// For a sealed image and a device without keys.
    Provision => "write keys into the device with a debug probe[ (coflash seal provision makes the file)|], or \
        [flash|choose] the program as it is, not sealed",
    /// For a sealed image that cannot be cut into blocks.
    OneDownload => "[send it in one download: leave out --blocks|the device takes this sealed image in one \
        download alone, which this page cannot choose]",
    /// For a bootloader in the place of a program.
    BootloaderFile => "[give|choose] the program, linked for an address after the bootloader; [coflash \
        flash|the page] renews a bootloader whose RAM image has a header, and a debug probe writes any other",
    /// For a program with another start than the region.
    OtherPlace => "let FLASH begin at that address in the linker script[ (cargo xtask layout --ld program-1 \
        prints the board's)|], or check [--board and --program; --force leaves that to the device|the fields \
        Board and Program]",
    /// For a stack in the handoff.
    StackOverHandoff => "let RAM end before the handoff in the linker script: 64 bytes less than the chip \
        has (LENGTH = 128K - 64), so that _estack or _stack_start is at most the handoff's address[; --force \
        leaves that to the device|]",
    /// For a reset vector outside the program.
    ResetVector => "check that it is the right file, and that it is linked for this address ([--board, \
        --program|the fields Board and Program])[; --force leaves that to the device|]",
    /// For code in the place of the vector table.
    VectorTable => "give the vector table its whole length, one vector for each interrupt of the chip, and \
        let the linker script place the code after it[; --force leaves that to the device|]",
    /// For any other image that is no program.
    NoVectorTable => "check that it is the right file, and that it begins with the vector table[; --force \
        leaves that to the device|]",
    /// For data at the alias of the flash.
    AreaAlias => "link the program for the flash, which begins at 08000000h; S1 and S2 records have no room \
        for such an address: write S3 records[ (objcopy --srec-forceS3), or add what is missing \
        (--adjust-start)|]",
    /// For data in an EEPROM.
    AreaEeprom => "an STM32F4 has no data EEPROM: leave this section out of the file",
    /// For data in the option bytes.
    AreaOptionBytes => "a bootloader does not write them: leave the section out of the file[ (objcopy \
        --remove-section, or --start-address and --end-address here)|], and set option bytes with a debug probe",
    /// For data in the system memory.
    AreaSystemMemory => "it cannot be written: leave this section out of the file",
    /// For data in the OTP area.
    AreaOtp => "a bootloader does not write it: leave the section out of the file[ (objcopy \
        --remove-section, or --start-address and --end-address here)|], and write it with a debug probe",
    /// For data in RAM.
    AreaRam => "it is empty after power-on: give the section a load address in the flash (AT > FLASH), from \
        where the start-up of the program copies it, or make it NOLOAD",
    /// For data in the backup SRAM.
    AreaBackupSram => "the program itself has to fill it: leave this section out of the file",
    /// For data at registers.
    AreaRegisters => "no file can fill them: leave this section out of the file",
    /// For data at a reserved address.
    AreaReserved => "check that the file is for an STM32F4; if it is, leave the section out of it[ (objcopy \
        --remove-section)|]",
    /// For data in an external memory.
    AreaExternal => "the bootloader writes the chip's own flash alone: leave the section out of the file[ \
        (objcopy --remove-section)|], and let the program or a debug probe write it",
    /// For a file that is no sealed image.
    GiveSealed => "[give a file that `coflash seal image` made|choose a sealed image]",
    /// For a sealed image that is damaged.
    CopyAgain => "copy the file again from where it was sealed, or seal the program again",
    /// For a sealed image of another format.
    SealedByOther => "seal the program again, with the [coflash|tool] that belongs to the bootloader",
    /// For a sealed image of another device.
    SealedForOther => "give the file of this device and program, or seal the program for it",
    /// For a sealed image of another chip.
    SealedForChip => "seal the program for this device[ (--device)|], or for all of the product",
    /// For a sealed image of another revision.
    SealedForRevision => "seal the program for this revision[ (--hardware)|], if it supports that revision",
    /// For a program that is too large.
    Smaller => "make the program smaller: [--compress|compression] makes the file smaller, not the program",
    /// For a security counter that is too low.
    HigherCounter => "seal the program with a higher [--counter|security counter], if it is to replace the \
        newer one",
    /// For a key of an old epoch.
    RevokedKey => "the key was revoked by a higher epoch: sign with the key that is valid now",
    /// For a certificate that does not cover the program.
    Certify => "have the key certified for this program[: `coflash seal keys certify`|]",
    /// For a root that is not given.
    GiveRoot => "[give the public key of the root that certified it (--root); `coflash seal show` shows its \
        id|seal it with a certificate of a root that the device has]",
    /// For a test key.
    ReleaseKey => "sign it with a release key[, or check it for a device for tests (--for-tests)|]",
    /// For a key-encryption key that is not given.
    GiveKek => "[give one of the keys that it is encrypted for (--kek); `coflash seal show` shows their \
        ids|encrypt it for a key of the device]",
    /// For a certificate of a stranger.
    UnknownCertificate => "do not use this file: the origin of its certificate is unknown",
    /// For a signature of a stranger.
    UnknownOrigin => "do not use this file: its origin is unknown; seal the program again",
    /// For a dictionary that is not given.
    GiveBase => "[give the program that it was sealed with as --base|choose the image that was sealed \
        without a base]",
    /// For a sealed image that its tool made wrong.
    SealAgain => "seal the program again: the tool that made this file has a fault",
    /// For an archive.
    Unpack => "unpack it, and [give|choose] the file in it",
    /// For a file of another tool or kind.
    Linked => "[give|choose] the linker's output: ELF, Intel HEX or S-record",
    /// For a page in place of a file.
    FetchAgain => "fetch the file itself, not the page that leads to it",
    /// For an image of MCUboot.
    Unsigned => "[give|choose] the image before imgtool has signed it (of Zephyr zephyr.elf), linked for this \
        bootloader without room for MCUboot's header (CONFIG_BOOTLOADER_MCUBOOT=n, CONFIG_ROM_START_OFFSET=0)",
    /// For a file with a DFU suffix.
    DfuSuffix => "[give|choose] the linker's output, or take the suffix off with dfu-suffix",
    /// For a file with programs for several boards.
    OneBoard => "[give|choose] the HEX file of your board alone",
    /// For a file with a program and other data.
    ProgramAlone => "[give|choose] the file of the program alone[, or leave out the rest: --start-address (in place \
        of --board) with the first address of the program, and --end-address|]; a debug probe writes the other data",
    /// For a program that covers staging.
    EndBeforeStaging => "for a renewal later, let the program end before that, with what the tool chain adds at \
        its end: a checksum, a trailer, fill bytes",
    /// For a raw binary among other files.
    RawNeedsAddress => "[for a raw binary give -I binary and --start-address|a raw binary needs a board]",
    /// For a sealed image in the place of a program.
    SealedStays => "[`coflash flash` downloads it, `coflash seal show` and `coflash seal verify` describe it|choose it \
        without a change]",
    /// For a raw binary without an address.
    GiveAddress => "[give --start-address or --board|choose the board]",
    /// For data that span too much.
    SelectRange => "[select the program with --start-address and --end-address|leave what is not of the \
        program out of the file]",
    /// For a stack that only some boards have room for.
    KnowBoard => "[--board|the field Board] says whether yours is one",
    /// For a file that can be a bootloader.
    RenewsDevice => "[coflash flash|the button Update] renews that of a device",
    /// For a file that is no program.
    IsRefused => "[coflash flash|an update] refuses it",
    /// For a program that is left unreleased.
    ReleaseIt { program: OfProgram } => "[coflash start{program} tries the program, coflash more \
        release{program} releases it|More … at the device{program} has Start the program, which tries it, and Release for autostart]",
    /// For a program that waits after a call.
    StartIt { program: OfProgram } => "[coflash start{program}|Start the program{program}, in More … at the \
        device,] starts it again",
    /// For a device whose next reset starts its program.
    StartNow { program: OfProgram } => "[coflash start{program}|Start the program{program}, in More … at the \
        device,] starts the program now",
    /// For an entry strap that is set.
    ReleaseStrap => "release the entry strap (a button or a jumper of the board), then reset the device",
    /// For a program that has crashed too often.
    CrashLoop { program: OfProgram } => "find out why the program ends; [coflash start{program}|Start the \
        program{program}, in More … at the device,] starts it again and counts anew",
    /// For a product without autostart.
    StartByCommand { program: OfProgram } => "[coflash start{program}|Start the program{program}, in More … \
        at the device,] starts the program; this product waits for that after each reset",
    /// For a bootloader that had a fault.
    BootloaderFault { program: OfProgram } => "[coflash start{program}|Start the program{program}, in More … \
        at the device,] starts the program now; if the fault happens again, [send a report (coflash more report) to|ask] the maker of the bootloader",
    /// For a device that was asked in its rescue window.
    AskedInWindow { program: OfProgram } => "[coflash start{program}|Start the program{program}, in More … at \
        the device,] starts the program now; let masters wait until its boot-up before they ask the device",
    /// For a trial of a bootloader.
    RenewalOpen { program: OfProgram } => "look at the line \"bootloader\": on trial it is confirmed by \
        [coflash flash|an update] with its file; after a trial [coflash start{program}|Start the \
        program{program}, in More … at the device,] starts the program",
    /// For a device that compacts its stored values.
    Compacts => "wait for a second: the program starts by itself",
    /// For a bootloader on trial.
    ConfirmIt => "[coflash flash|an update] with its file confirms it",
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::{Path, PathBuf};

    use super::{of_front, Front, TABLE};

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
        assert!(
            TABLE.iter().filter(|row| is_of_command_line(&of_front(row.2, Front::Terminal))).count() > 50
        );
        for (name, placeholder, sentence) in TABLE {
            let [terminal, page] = [Front::Terminal, Front::Page].map(|front| of_front(sentence, front));
            assert!(!page.is_empty() && !is_of_command_line(&page), "{name}: {page}");
            let named = if placeholder.is_empty() { terminal + &page } else { page.replace(placeholder, "") };
            assert!(!named.contains(['[', '|', ']', '{', '}']), "{name}: {named}");
            assert!(sentence.contains(placeholder), "{name}");
        }
    }

    /// What only the command line uses: keys, packages, the file for production, the comparison before delivery, and the diagnosis of a
    /// silent device.
    const OF_COMMAND_LINE: [&str; 9] = [
        "device/delivery.rs",
        "device/diagnose.rs",
        "file/factory.rs",
        "file/sealed/blocks.rs",
        "file/sealed/key.rs",
        "file/sealed/key_block.rs",
        "file/sealed/lzma.rs",
        "file/sealed/sealer.rs",
        "machine/fault.rs",
    ];

    fn sources(folder: &Path) -> Vec<PathBuf> {
        let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
        entries.flat_map(|path| if path.is_dir() { sources(&path) } else { vec![path] }).collect()
    }

    /// Whether a line names an option, or a command of coflash.
    fn names_command_line(line: &str) -> bool {
        let starts_word = |rest: &str| rest.starts_with(|c: char| c.is_ascii_lowercase());
        let line = line
            .replace("another coflash ", "")
            .replace("this coflash ", "")
            .replace("probe-rs write --", "");
        let has = |words: &str| line.split(words).skip(1).any(starts_word);
        let has_command = line.split("coflash ").skip(1).any(starts_word);
        has(" --") || has("(--") || has("\"--") || has_command
    }

    /// A front can only word what is here.
    #[test]
    fn no_other_text_names_an_option_or_a_command() {
        assert!(names_command_line("\"give --board\"") && names_command_line("`coflash flash` downloads it"));
        assert!(!names_command_line("another coflash, process 5, is at work -- or not"));
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
        let mut found = Vec::new();
        for path in sources(&root) {
            let name = path.strip_prefix(&root).unwrap().to_string_lossy().replace('\\', "/");
            if name == "advice.rs" || OF_COMMAND_LINE.contains(&name.as_str()) {
                continue;
            }
            let text = fs::read_to_string(&path).unwrap();
            let code = text.split("#[cfg(test)]").next().unwrap();
            let lines = code.lines().filter(|line| !line.trim_start().starts_with("//"));
            found.extend(lines.filter(|line| names_command_line(line)).map(|line| format!("{name}: {line}")));
        }
        assert!(found.is_empty(), "move it into advice.rs:\n{}", found.join("\n"));
    }
}
