//! `cargo xtask new-board`: writes the files of a port. It changes no other file.

use new_board::Choices;

use crate::args::Args;
use crate::{files, outcome::Outcome, workspace};

pub const HELP: &str = "\
usage: cargo xtask new-board NAME --chip CHIP [--product-code CODE] [--crystal HZ] [--can N] [--pins TX,RX]
                             [--led PIN] [--strap PIN]

Creates the files of a port, with numbered steps to go through: the memory map, the board file, and the
header with the same numbers for the application in C (for CAN1 at alternate function 9 alone). Nothing else has
to be changed. The files build as they are. Pins and crystal are checked before a file is written.
docs/porting.md has the next steps.

  NAME            of the board, as it will be given to --board: small letters, digits and hyphens
  --chip CHIP     its chip as it is ordered, STM32F407VGT6: any STM32F4 with CAN controllers
  --product-code CODE  of the device (1018h/2), as 1234 or 0x4D2 (default: made from the NAME)
  --crystal HZ    the crystal, 4000000 to 26000000 (default: 8000000). The clocks are made from it
  --can N         the CAN controller, 1 or 2 (default: that of --pins, or 1)
  --pins TX,RX    the pins to the transceiver: PB9,PB8 (default: such as each package has)
  --led PIN       the LED (default: PC13, or PA5 if the board uses that one)
  --strap PIN     a pin that keeps the device in the bootloader while it is low; the chip pulls it up
";

pub fn run(mut args: Args) -> Outcome {
    let chip = args.value("--chip")?.ok_or("--chip is needed: which chip is on the board?")?;
    let choices = Choices {
        crystal: args.value("--crystal")?,
        can: args.value("--can")?,
        pins: args.value("--pins")?,
        led: args.value("--led")?,
        strap: args.value("--strap")?,
        product_code: args.value("--product-code")?,
    };
    let mut words = args.remaining().into_iter();
    let (Some(name), None) = (words.next(), words.next()) else {
        return Err("one NAME is needed, and nothing else; --help says more.".into());
    };
    let root = workspace::root();
    let files = new_board::board(&name, &chip, &choices)?;
    for (path, _) in &files {
        if root.join(path).exists() {
            return Err(format!("{path} exists already; remove it, or choose another name."));
        }
    }
    for (path, text) in &files {
        files::write(&root.join(path), text)?;
        println!("  new      {path}");
    }
    println!(
        "\nIts product code is {:08X}h (step 5): bootloader and programs are for this product alone.\nNow go through the steps in the new files; docs/porting.md says which test proves each.\n\
         Then: cargo xtask build --board {name} && cargo xtask test --board {name} --test update main_job::",
        new_board::product_code(&name, &choices)?,
    );
    Ok(())
}
