//! Arranges the help: options in groups, `-h` short and with examples, `--help` with all options.
//!
//! The help text of an option is at the option; this file gives its place.

use clap::{Arg, Command};

use super::output::EXIT_CODES;

/// The groups of `--help`, with the options in each.
const GROUPS: [(&str, &[&str]); 5] = [
    ("Devices", &["node", "job", "at_once", "together", "program", "report", "trust", "yes"]),
    (
        "Firmware file",
        &[
            "board",
            "start_address",
            "end_address",
            "block_size",
            "gap_fill",
            "block_max_gap",
            "adjust_start",
            "crc16",
            "last_block_2008",
            "format",
            "vid",
            "pid",
            "ver",
            "date",
            "no_label",
            "force",
        ],
    ),
    (
        "Update",
        &[
            "check_target",
            "no_trial",
            "no_start",
            "verify",
            "wait",
            "not_alone",
            "no_mastership",
            "in_blocks",
            "from_start",
            "block_repeats",
        ],
    ),
    (
        "Time and transfer",
        &[
            "sdo_timeout",
            "sdo_attempts",
            "command_timeout",
            "silence_timeout",
            "boot_timeout",
            "delay",
            "repeats",
            "segmented",
        ],
    ),
    ("Devices of other makers", &["dialect", "unlock"]),
];

/// Options for special cases: only `--help` shows them, not `-h`.
const RARE: [&str; 39] = [
    "trace",
    "log_file",
    "report_dir",
    "json_events",
    "quiet",
    "verbose",
    "block_size",
    "at_once",
    "report",
    "end_address",
    "gap_fill",
    "block_max_gap",
    "adjust_start",
    "crc16",
    "last_block_2008",
    "ver",
    "date",
    "no_label",
    "not_alone",
    "no_mastership",
    "in_blocks",
    "from_start",
    "block_repeats",
    "search",
    "sdo_attempts",
    "command_timeout",
    "silence_timeout",
    "boot_timeout",
    "delay",
    "repeats",
    "segmented",
    "sdo_request",
    "sdo_response",
    "legacy_exit_codes",
    "config",
    "index",
    "baudrate",
    "vxd_type",
    "temp",
];

/// Options of the manual's tools; `-h` does not show their group.
const LEGACY: [&str; 4] = ["serial", "revision", "product", "vendor"];

/// Typical calls of each command; the empty name is the program itself.
const EXAMPLES: [(&str, &str); 38] = [
    (
        "",
        "\
Examples:
  coflash scan --bus socketcan:can0
  coflash flash app.elf --board stm32f407g-disc1 --node 5
  coflash read 1008 1018/1..4 --node 5
  coflash monitor --bus slcan:/dev/ttyACM0@500k

Without --bus, COFLASH_BUS or coflash.toml says where the bus is.
coflash COMMAND -h has a command's options in short, --help all of them.",
    ),
    (
        "flash",
        "\
Examples:
  coflash flash app.elf --board stm32f407g-disc1 --node 5
  coflash flash app.blk --node 5-9 --check-target --verify
  coflash flash app.hex --board my-board.toml
  coflash flash --job line.toml --report result.json
  coflash flash machine.cpk --trust root.pub",
    ),
    (
        "report",
        "\
Examples:
  coflash report bundle reports --node 5
  coflash report bundle reports/20261128T091500-flash -o fault.zip",
    ),
    (
        "package",
        "\
Examples:
  coflash package machine.toml
  coflash package machine.toml -o press-4.cpk --key release.pem --cert release.cert",
    ),
    (
        "convert",
        "\
Examples:
  coflash convert app.elf --board stm32f407g-disc1
  coflash convert app.hex app.blk --vid 0x3F --pid 1234 --ver 0x00000001
  coflash convert app.elf --key cf7a7fe196f64c6b8f19e58361d2397e --sign release.pem --cert release.cert --counter 7",
    ),
    (
        "inspect",
        "\
Examples:
  coflash inspect app.blk
  coflash inspect app.elf --board stm32f407g-disc1",
    ),
    (
        "key",
        "\
Examples:
  coflash key new --role root
  coflash key new --role release
  coflash key certify --root root.pem --key release.pub --epoch 1 --vendor 0x3F
  coflash key show release.cert",
    ),
    (
        "seal",
        "\
Examples:
  coflash seal app.elf --board stm32f407g-disc1 --key release.pem --cert release.cert --counter 1
  coflash seal app.elf --key release.pem --cert release.cert --counter 1 --compress --encrypt kek.pem
  coflash seal app.elf --board stm32f407g-disc1 --key release.pem --cert release.cert --counter 1 --blocks",
    ),
    (
        "verify",
        "\
Examples:
  coflash verify app.cbs --root root.pub
  coflash verify app.cbs --root root.pub --kek kek.pem --product 1234 --counter 7",
    ),
    (
        "verify-device",
        "\
Examples:
  coflash verify-device app.cbs --root root.pub --node 5",
    ),
    (
        "show",
        "\
Examples:
  coflash show app.cbs
  coflash show app.cbs --json",
    ),
    (
        "provision",
        "\
Examples:
  coflash provision bootloader-sealed.elf --board stm32f407g-disc1 --root root.pub -o production.hex",
    ),
    (
        "nameplate",
        "\
Examples:
  coflash nameplate plate.hex --vendor 0x123 --product 0x5EA10007 --revision 0x00020003 --lock
  coflash nameplate plate.hex --vendor 0x123 --product 0x5EA10007 --revision 0x00020004 --block 1",
    ),
    (
        "scan",
        "\
Examples:
  coflash scan
  coflash scan --nodes 1-10 --json
  coflash scan --listen-only",
    ),
    (
        "read",
        "\
Examples:
  coflash read 100A
  coflash read 1000 1008 1018/1..4 --node 5
  coflash read \"Program control/1\" --eds device.eds
  coflash read --file objects.txt --json
  coflash read 1F50/1 --output backup.bin",
    ),
    (
        "write",
        "\
Examples:
  coflash write 1017 500 --type u16 --node 5
  coflash write \"Producer heartbeat time\" 500 --eds device.eds
  coflash write 2000/1 -7 --type i16
  coflash write 2010 parameters.bin --type domain-from-file",
    ),
    (
        "nmt",
        "\
Examples:
  coflash nmt start --node 5
  coflash nmt pre-operational --node all
  coflash nmt reset --node 5",
    ),
    (
        "lss",
        "\
Examples:
  coflash lss fastscan --assign 5 --store
  coflash lss assign --node 7 --store",
    ),
    (
        "reset",
        "\
Examples:
  coflash reset --node 5
  coflash reset --all",
    ),
    (
        "monitor",
        "\
Examples:
  coflash monitor
  coflash monitor --replay bus.log",
    ),
    (
        "info",
        "\
Examples:
  coflash info --node 5
  coflash info --node 5 --json",
    ),
    (
        "shell",
        "\
Examples:
  coflash shell --bus socketcan:can0
  coflash shell --log-file session.log",
    ),
    (
        "adapters",
        "\
Examples:
  coflash adapters
  coflash adapters --search serial,socketcan
  coflash adapters --json",
    ),
    (
        "status",
        "\
Examples:
  coflash status --node 5
  coflash status --node 5 --program 2 --json",
    ),
    (
        "start",
        "\
Examples:
  coflash start --node 5",
    ),
    (
        "enter",
        "\
Examples:
  coflash enter --node 5
  coflash enter --node 5 --wait",
    ),
    (
        "catch",
        "\
Examples:
  coflash catch --node 5
  coflash catch --any --within 60000",
    ),
    (
        "erase",
        "\
Examples:
  coflash erase --node 5",
    ),
    (
        "release",
        "\
Examples:
  coflash release --node 5",
    ),
    (
        "withdraw",
        "\
Examples:
  coflash withdraw --node 5",
    ),
    (
        "unlock",
        "\
Examples:
  coflash unlock erase --root root.pem --node 5
  coflash unlock lower-counter --counter 3 --root root.pem --node 5",
    ),
    (
        "events",
        "\
Examples:
  coflash events --node 5",
    ),
    (
        "debug",
        "\
Examples:
  coflash debug read 0x20000000 64 --node 5
  coflash debug break 0x08020204 --node 5",
    ),
    (
        "conform",
        "\
Examples:
  coflash conform --list
  coflash conform SDO LSS --node 5 --junit report.xml
  coflash conform --install --image app.elf --node 5",
    ),
    (
        "ui",
        "\
Examples:
  coflash ui
  coflash ui --bus socketcan:can0 --port 8080 --no-open",
    ),
    (
        "agent",
        "\
Examples:
  coflash agent --hawkbit https://hawkbit.example.com
  coflash agent --devices line.toml --once",
    ),
    (
        "completions",
        "\
Examples:
  coflash completions bash",
    ),
    (
        "man",
        "\
Examples:
  coflash man
  coflash man --out man1",
    ),
];

/// The examples of a command.
pub(super) fn examples(name: &str) -> Option<&'static str> {
    EXAMPLES.iter().find(|(of, _)| *of == name).map(|(_, text)| *text)
}

/// The commands with their help in order.
pub(super) fn in_order(command: Command) -> Command {
    let root = examples("").unwrap_or_default();
    let command = command.after_help(root).after_long_help(format!("{root}\n\n{EXIT_CODES}"));
    below(command.mut_args(placed), &|name| examples(name))
}

/// Arranges the subcommands; their own subcommands have no examples.
fn below(command: Command, examples: &dyn Fn(&str) -> Option<&'static str>) -> Command {
    let names: Vec<String> = command.get_subcommands().map(|below| below.get_name().to_string()).collect();
    names.into_iter().fold(command, |command, name| {
        let text = examples(&name);
        command.mut_subcommand(name, |command| {
            let command = below(command.mut_args(placed), &|_| None);
            match text {
                Some(text) => command.after_help(text),
                None => command,
            }
        })
    })
}

fn placed(argument: Arg) -> Arg {
    let id = argument.get_id().as_str().to_string();
    let rare =
        RARE.contains(&id.as_str()) || LEGACY.contains(&id.as_str()) && argument.get_help_heading().is_some();
    let group = GROUPS.iter().find(|(_, ids)| ids.contains(&id.as_str()));
    let argument = argument.hide_short_help(rare).hide_env_values(true);
    match group {
        Some((group, _)) if argument.get_help_heading().is_none() && !argument.is_positional() => {
            argument.help_heading(*group)
        }
        _ => argument,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_example_is_understood() {
        let mut count = 0;
        for (name, text) in EXAMPLES {
            if name == "ui" && !cfg!(feature = "ui")
                || name == "agent" && !cfg!(feature = "agent")
                || name == "conform" && !cfg!(feature = "conform")
            {
                continue;
            }
            for line in text.lines().filter_map(|line| line.strip_prefix("  coflash ")) {
                // No example has a blank inside quotes, except in names.
                let mut words = vec!["coflash".to_string()];
                for (number, part) in line.split('"').enumerate() {
                    match number % 2 {
                        0 => words.extend(part.split_whitespace().map(String::from)),
                        _ => words.push(part.to_string()),
                    }
                }
                let read = super::super::commands().try_get_matches_from(&words);
                if let Err(error) = read {
                    panic!("{line}: {error}");
                }
                assert!(name.is_empty() || words[1] == name, "{line}");
                count += 1;
            }
        }
        assert!(count > 30, "{count}");
    }

    #[test]
    fn every_command_has_examples() {
        let command = super::super::commands();
        let names = command.get_subcommands().filter(|below| !below.is_hide_set()).map(Command::get_name);
        for name in names.filter(|name| *name != "help") {
            assert!(examples(name).is_some(), "{name}");
        }
    }

    /// Every option in the groups exists, and every option of `flash` that `-h` shows has a line
    /// that fits.
    #[test]
    fn the_groups_name_options_that_there_are() {
        let command = super::super::commands();
        let has = |id: &str| {
            let own = |command: &Command| command.get_arguments().any(|argument| argument.get_id() == id);
            own(&command) || command.get_subcommands().any(own)
        };
        for id in GROUPS.iter().flat_map(|(_, ids)| ids.iter()).chain(&RARE).chain(&LEGACY) {
            assert!(has(id), "{id}");
        }
    }
}
