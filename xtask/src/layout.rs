//! `cargo xtask layout`: prints the memory map, as text and for linkers.

use shared_abi::layout::toml::Toml;
use shared_abi::layout::{Image, Layout};

use crate::args::Args;
use crate::{outcome::Outcome, workspace};

pub const HELP: &str = "\
usage: cargo xtask layout [--board BOARD] [--ld IMAGE | --toml]

Prints the memory map of a board from the one source of truth, shared-abi/src/layout/.

  --board BOARD   the board (default: stm32f407g-disc1)
  --ld IMAGE      prints the linker's MEMORY and border symbols instead, for an IMAGE of
                  `bootloader` or `program-N` (N from 1); a C application includes it too
  --toml          prints the map for `coflash --board FILE.toml` instead: for a coflash that was built
                  without the board. `cargo xtask build` writes it with the circuit around the chip
";

pub fn run(mut args: Args) -> Outcome {
    let board = workspace::board(&mut args)?;
    let ld = args.value("--ld")?;
    let toml = args.flag("--toml");
    args.none_left()?;
    match ld {
        Some(_) if toml => return Err("--ld and --toml exclude each other.".to_string()),
        None if toml => print!("{}", Toml(board)),
        None => print!("{board}"),
        Some(image) => print!("{}", board.linker_script(image_by_name(board, &image)?)),
    }
    Ok(())
}

fn image_by_name(board: &Layout, name: &str) -> Outcome<Image> {
    if name == "bootloader" {
        return Ok(Image::Bootloader);
    }
    let number = name.strip_prefix("program-").and_then(|number| number.parse().ok());
    match number {
        Some(number) if board.program(number).is_some() => Ok(Image::Program(number)),
        _ => {
            Err(format!("--ld takes `bootloader` or `program-1` to `program-{}` here.", board.programs.len()))
        }
    }
}

#[cfg(test)]
mod tests {
    use shared_abi::layout::stm32f407g_disc1::LAYOUT;

    use super::*;
    use crate::files;

    #[test]
    fn an_image_is_chosen_by_name_and_only_one_that_exists() {
        assert_eq!(image_by_name(&LAYOUT, "bootloader"), Ok(Image::Bootloader));
        assert_eq!(image_by_name(&LAYOUT, "program-1"), Ok(Image::Program(1)));
        for wrong in ["program-0", "program-2", "program-", "program-256", "program-x", "app", ""] {
            assert!(image_by_name(&LAYOUT, wrong).is_err(), "{wrong}");
        }
    }

    /// The blocks on the pages are what the job prints; the README leaves out blanks at the end of a line.
    #[test]
    fn the_pages_show_what_the_job_prints() {
        let block = LAYOUT.linker_script(image_by_name(&LAYOUT, "program-1").unwrap()).to_string();
        let command = "cargo xtask layout --ld program-1 --board stm32f407g-disc1";
        for (page, marker, printed) in [
            ("README.md", "memory map: `cargo xtask layout` prints it -->\n", LAYOUT.to_string()),
            ("docs/application.md", &format!("printed by: {command} -->"), block),
        ] {
            let text = files::ours(page).unwrap();
            let (_, behind) = text.split_once(&format!("<!-- {marker}\n```text\n")).expect(page);
            let (copy, _) = behind.split_once("```").unwrap();
            let printed: String = printed.lines().map(|line| format!("{}\n", line.trim_end())).collect();
            assert_eq!(copy, printed, "copy what `cargo xtask layout` prints into {page}");
        }
    }
}
