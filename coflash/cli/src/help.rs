//! Arranges the help: commands and options in groups, `-h` short, `--help` with all options.
//!
//! The help text of a command or an option is at it; this file gives its place.

use std::fmt::Write as _;

use clap::builder::StyledStr;
use clap::{Arg, Command};

use super::output::EXIT_CODES;

/// The groups of the commands.
const COMMANDS: [(&str, &str); 6] = [
    ("A device", "flash info scan start enter erase reset"),
    ("Files", "convert inspect"),
    ("Sealed devices", "seal"),
    ("The bus", "read write lss nmt monitor"),
    ("Many devices", "package agent ui"),
    ("More", "adapters more"),
];

/// The groups of a command's options in `--help`, with the options in each.
const OPTIONS: [(&str, &str); 5] = [
    ("Devices", "node job at_once together program report trust yes"),
    (
        "Firmware file",
        "board start_address end_address block_size gap_fill block_max_gap adjust_start crc16 last_block_2008 \
         format vid pid ver date no_label force",
    ),
    (
        "Update",
        "check_target no_trial no_start verify wait not_alone no_mastership in_blocks from_start block_repeats",
    ),
    (
        "Time and transfer",
        "sdo_timeout sdo_attempts command_timeout silence_timeout boot_timeout delay repeats segmented",
    ),
    ("Devices of other makers", "dialect unlock"),
];

/// Typical calls. Each one is an example of the command that it calls.
const EXAMPLES: &str = "\
flash app.elf --board stm32f407g-disc1 --node 5
flash app.blk --node 5-9 --check-target --verify
flash app.hex --board my-board.toml
flash --job line.toml --report result.json
flash machine.cpk --trust root.pub
info --node 5
info --node 5 --json
scan
scan --nodes 1-10 --json
scan --listen-only
start --node 5
enter --node 5
enter --node 5 --wait
erase --node 5
reset --node 5
reset --all
convert app.elf --board stm32f407g-disc1
convert app.hex app.blk --vid 0x3F --pid 1234 --ver 0x00000001
convert app.elf --key cf7a7fe196f64c6b8f19e58361d2397e --sign release.pem --cert release.cert --counter 7
inspect app.blk
inspect app.elf --board stm32f407g-disc1
seal keys new --role root
seal keys new --role release
seal keys certify --root root.pem --key release.pub --epoch 1 --vendor 0x3F
seal keys show release.cert
seal provision bootloader-sealed.elf --board stm32f407g-disc1 --root root.pub -o production.hex
seal nameplate plate.hex --vendor 0x123 --product 0x5EA10007 --revision 0x00020003 --lock
seal nameplate plate.hex --vendor 0x123 --product 0x5EA10007 --revision 0x00020004 --block 1
seal factory bootloader.elf app.elf --board stm32f407g-disc1 -o factory.hex
seal factory production.hex app.cbs --board stm32f407g-disc1 -o factory.elf --option-bytes options.txt --brown-out 3
seal image app.elf --board stm32f407g-disc1 --key release.pem --cert release.cert --counter 1
seal image app.elf --key release.pem --cert release.cert --counter 1 --compress --encrypt kek.pem
seal image app.elf --board stm32f407g-disc1 --key release.pem --cert release.cert --counter 1 --blocks
seal show app.cbs
seal show app.cbs --json
seal verify app.cbs --root root.pub
seal verify app.cbs --root root.pub --kek kek.pem --product 1234 --counter 7
seal verify-device app.cbs --root root.pub --node 5
seal unlock erase --root root.pem --node 5
seal unlock lower-counter --counter 3 --root root.pem --node 5
seal events --node 5
read 100A
read 1000 1008 1018/1..4 --node 5
read \"Program control/1\" --eds device.eds
read --file objects.txt --json
read 1F50/1 --output backup.bin
write 1017 500 --type u16 --node 5
write \"Producer heartbeat time\" 500 --eds device.eds
write 2000/1 -7 --type i16
write 2010 parameters.bin --type domain-from-file
lss fastscan --assign 5 --store
lss assign --node 7 --store
nmt start --node 5
nmt pre-operational --node all
nmt reset --node 5
monitor
monitor --replay bus.log
package machine.toml
package machine.toml -o press-4.cpk --key release.pem --cert release.cert
agent --hawkbit https://hawkbit.example.com
agent --devices line.toml --once
ui
ui --bus socketcan:can0 --port 8080 --no-open
adapters
adapters --search serial,socketcan
adapters --json
more status --node 5
more status --node 5 --program 2 --json
more catch --node 5
more catch --any --within 60000
more release --node 5
more withdraw --node 5
more debug read 0x20000000 64 --node 5
more debug break 0x08020204 --node 5
more report bundle reports --node 5
more report bundle reports/20261128T091500-flash -o fault.zip
more shell --bus socketcan:can0
more shell --log-file session.log
more conform --list
more conform SDO LSS --node 5 --junit report.xml
more conform --install --image app.elf --node 5
more completions bash
more man
more man --out man1";

/// The end of `coflash --help`.
const FIRST: &str = "\
Examples:
  coflash scan --bus socketcan:can0
  coflash flash app.elf --board stm32f407g-disc1 --node 5
  coflash read 1008 1018/1..4 --node 5
  coflash monitor --bus slcan:/dev/ttyACM0@500k

Without --bus, COFLASH_BUS or coflash.toml says where the bus is.";

/// The calls among the examples that begin with these words.
pub(super) fn examples(command: &str) -> Vec<&'static str> {
    let is_of = |line: &&str| {
        let rest = command.strip_prefix("coflash ").and_then(|path| line.strip_prefix(path));
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(' '))
    };
    EXAMPLES.lines().filter(is_of).collect()
}

/// The commands with their help in order.
pub(super) fn in_order(command: Command) -> Command {
    let options = command.clone().mut_args(placed).help_template("{options}").render_long_help();
    let about = command.get_about().map(StyledStr::ansi).map(|about| about.to_string()).unwrap_or_default();
    let list = list(&command);
    let short = format!("{list}coflash COMMAND -h shows its options, coflash --help those of all commands.");
    let long = format!("{about}.\n\n{list}\nFor all commands:\n{}\n{FIRST}\n\n{EXIT_CODES}", options.ansi());
    let command = command.help_template("{usage-heading} {usage}\n\n{before-help}");
    below(command.mut_args(placed).before_help(short).before_long_help(long), "coflash")
}

/// A line for each command, with its group before the first one.
fn list(command: &Command) -> String {
    // A style at the start of a line would confuse the wrapping of clap.
    let name = command.get_styles().get_literal();
    let mut text = String::new();
    for (group, names) in COMMANDS {
        // A command may be left out of the program by a feature.
        let known = names.split(' ').filter_map(|name| command.find_subcommand(name));
        for (number, below) in known.enumerate() {
            let group = if number == 0 { group } else { "" };
            let about = below.get_about().map(ToString::to_string).unwrap_or_default();
            // Writing into memory does not fail.
            let _ = writeln!(text, "{group:<16}{name}{:<10}{name:#}{about}", below.get_name());
        }
    }
    text
}

/// Arranges the subcommands of the command with these words.
fn below(command: Command, path: &str) -> Command {
    command.mut_subcommands(|command| {
        let path = format!("{path} {}", command.get_name());
        let command = below(command.mut_args(placed), &path);
        let lines: String = examples(&path).iter().map(|line| format!("\n  coflash {line}")).collect();
        // The commands of a group show their own examples.
        if lines.is_empty() || command.get_subcommands().any(Command::has_subcommands) {
            command
        } else {
            command.after_help(format!("Examples:{lines}"))
        }
    })
}

fn placed(argument: Arg) -> Arg {
    let id = argument.get_id().as_str();
    let group =
        OPTIONS.iter().find(|(_, ids)| ids.split(' ').any(|other| other == id)).map(|(group, _)| *group);
    let is_free = argument.get_help_heading().is_none() && !argument.is_positional();
    let argument = argument.hide_env_values(true);
    match group.filter(|_| is_free) {
        Some(group) => argument.help_heading(group),
        None => argument,
    }
}

#[cfg(test)]
mod tests {
    use super::super::commands;
    use super::*;

    /// Every example is understood, and is one of a command.
    #[test]
    fn every_example_is_understood() {
        let first = FIRST.lines().filter_map(|line| line.strip_prefix("  coflash "));
        let mut count = 0;
        for line in EXAMPLES.lines().chain(first) {
            let name = line.split(' ').find(|word| *word != "more").unwrap_or_default();
            if name == "ui" && !cfg!(feature = "ui")
                || name == "agent" && !cfg!(feature = "agent")
                || name == "conform" && !cfg!(feature = "conform")
            {
                continue;
            }
            // No example has a blank inside quotes, except in names.
            let mut words = vec!["coflash".to_string()];
            for (number, part) in line.split('"').enumerate() {
                match number % 2 {
                    0 => words.extend(part.split_whitespace().map(String::from)),
                    _ => words.push(part.to_string()),
                }
            }
            if let Err(error) = commands().try_get_matches_from(&words) {
                panic!("{line}: {error}");
            }
            count += 1;
        }
        assert!(count > 60, "{count}");
    }

    #[test]
    fn every_command_has_examples() {
        let root = commands();
        let groups = ["seal", "more"].map(|name| root.find_subcommand(name).unwrap());
        let inner = groups.iter().flat_map(|group| {
            group.get_subcommands().map(|below| format!("coflash {} {}", group.get_name(), below.get_name()))
        });
        let outer = root.get_subcommands().map(|below| format!("coflash {}", below.get_name()));
        for path in inner.chain(outer) {
            assert!(!examples(&path).is_empty(), "{path}");
        }
    }

    /// The first screen fits a terminal of 24 lines and 80 columns, and has every command.
    #[test]
    fn the_first_screen_fits_a_terminal() {
        let root = commands();
        let mut listed: Vec<&str> = COMMANDS.iter().flat_map(|(_, names)| names.split(' ')).collect();
        let mut names: Vec<&str> = root.get_subcommands().map(Command::get_name).collect();
        listed.sort_unstable();
        names.sort_unstable();
        if cfg!(all(feature = "ui", feature = "agent")) {
            assert_eq!(listed, names);
        }
        assert!(names.len() <= 20, "{names:?}");
        let nothing = commands().try_get_matches_from(["coflash"]).unwrap_err().to_string();
        let asked = commands().try_get_matches_from(["coflash", "-h"]).unwrap_err().to_string();
        assert_eq!(nothing, asked);
        let wide = asked.lines().find(|line| line.chars().count() > 80);
        assert!(asked.lines().count() <= 24 && wide.is_none(), "{asked}\n{wide:?}");
    }

    /// Every option in the groups exists.
    #[test]
    fn the_groups_name_options_that_there_are() {
        let command = commands();
        let has = |id: &str| {
            let own = |command: &Command| command.get_arguments().any(|argument| argument.get_id() == id);
            own(&command) || command.get_subcommands().any(own)
        };
        for id in OPTIONS.iter().flat_map(|(_, ids)| ids.split(' ')) {
            assert!(has(id), "{id}");
        }
    }
}
