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
                  without the board
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

    /// The map in the README is the one that `cargo xtask layout` prints.
    #[test]
    fn the_readme_shows_the_map_as_it_is() {
        let readme = files::ours("README.md").unwrap();
        let (_, behind) =
            readme.split_once("<!-- memory map: `cargo xtask layout` prints it -->\n\n```text\n").unwrap();
        let (copy, _) = behind.split_once("```").unwrap();
        let map = LAYOUT.to_string();
        // The README leaves out blanks at the end of a line.
        let lines = |text: &str| text.lines().map(|line| line.trim_end().to_owned()).collect::<Vec<_>>();
        assert_eq!(lines(copy), lines(&map), "copy the output of `cargo xtask layout` into README.md");
    }

    /// The block in the guide for applications can be linked unchanged: it is the printed one.
    #[test]
    fn the_guide_shows_the_linker_block_as_it_is() {
        let guide = files::ours("docs/application.md").unwrap();
        let command = "cargo xtask layout --ld program-1 --board stm32f407g-disc1";
        let (_, behind) = guide.split_once(&format!("<!-- printed by: {command} -->\n```text\n")).unwrap();
        let (copy, _) = behind.split_once("```").unwrap();
        let printed = LAYOUT.linker_script(image_by_name(&LAYOUT, "program-1").unwrap()).to_string();
        assert_eq!(copy, printed, "copy the output of `{command}` into docs/application.md");
    }
}
