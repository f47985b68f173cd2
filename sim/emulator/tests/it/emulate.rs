//! The `emulate` command as a separate process, with programs of a few instructions.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use crate::assembler::assemble;

fn emulate(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_emulate")).args(args).output().expect("the command starts")
}

/// What it prints when it succeeds.
#[track_caller]
fn prints(args: &[&str]) -> String {
    let output = emulate(args);
    assert!(output.status.success(), "{output:?}");
    String::from_utf8(output.stdout).unwrap()
}

/// A folder of its own for each test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// Initial SP, reset vector, then the code of `emulate/NAME.s` from 0800_0008h on.
fn program(folder: &Path, name: &str) -> String {
    let mut bytes = Vec::new();
    bytes.extend(0x2000_1000_u32.to_le_bytes());
    bytes.extend(0x0800_0009_u32.to_le_bytes());
    bytes.extend(assemble(&format!("sim/emulator/tests/it/emulate/{name}.s"), 0x0800_0008).code);
    let path = folder.join("program.bin");
    std::fs::write(&path, bytes).unwrap();
    format!("{}@08000000", path.display())
}

#[test]
fn runs_for_the_time_it_is_told() {
    let folder = folder("time");
    let trace = folder.join("trace.log");
    let image = program(&folder, "forever");
    let args =
        ["--bootloader", &image, "--speed", "max", "--for", "0.25", "--trace", trace.to_str().unwrap()];
    let text = prints(&args);
    assert_eq!(text, "0.000000 board: power on\n0.250000 end: 0 frames, 0 error frames\n");
    assert_eq!(std::fs::read(trace).unwrap(), b"");
    let board = ["--board", "stm32f407g-disc1", &image, "--speed", "max", "--for", "0.01"];
    let text = prints(&[&board[..], &["--node-count", "2"]].concat());
    assert!(text.contains("board 1: power on") && text.contains("board 2: power on"), "{text}");
}

/// A board that the emulator was not built with.
#[test]
fn takes_the_memory_map_of_a_board_and_refuses_a_bad_one() {
    let map = include_str!("my-board.toml");
    let folder = folder("board");
    let image = program(&folder, "forever");
    let board = |text: &str| {
        let file = folder.join("my.toml");
        std::fs::write(&file, text).unwrap();
        emulate(&["--board", file.to_str().unwrap(), &image, "--speed", "max", "--for", "0.01"])
    };
    let output = board(map);
    assert!(output.status.success(), "{output:?}");
    let huge = map
        .replace("ccm = { base = 0x10000000, size = 0x10000", "ccm = { base = 0x10000000, size = 0xe0000000");
    assert_ne!(huge, map);
    let other = map.replace("name = \"stm32f407vg\"", "name = \"stm32f407xx\"");
    for (text, says) in [
        ("", "my.toml: line 1: missing field"),
        ("board = [", "my.toml: line 1: "),
        (&huge, "my.toml: there is no stm32f407vg with these memories"),
        (&other, "my.toml: there is no stm32f407xx with these memories"),
    ] {
        let output = board(text);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && said.contains(says), "{says}: {said}");
    }
    for (word, says) in [("arduino", "known boards: nucleo-f446re"), ("none.toml", "none.toml: ")] {
        let output = emulate(&["--board", word, &image]);
        assert!(String::from_utf8_lossy(&output.stderr).contains(says), "{word}: {output:?}");
    }
}

/// A failure with a seed can be seen again: the seed and what it draws are printed. Without the option
/// nothing is.
#[test]
fn prints_the_chip_that_was_chosen() {
    let image = program(&folder("silicon"), "forever");
    let lines = |args: &[&str]| -> Vec<String> {
        let text = prints(&[&[&image, "--speed", "max", "--for", "0.01"], args].concat());
        text.lines().filter(|line| line.contains("silicon")).map(str::to_owned).collect()
    };
    assert_eq!(lines(&[]), [""; 0]);
    // Datasheet DocID022152: the ends of the ranges.
    for (choice, words) in [
        ("typical", "board: silicon typical: LSI 32000 Hz, HSI 16000000 Hz"),
        ("worst", "board: silicon worst: LSI 47000 Hz, HSI 16640000 Hz"),
        ("7", "board: silicon 7: LSI "),
    ] {
        let reported = lines(&["--silicon", choice]);
        assert!(reported.len() == 1 && reported[0].starts_with(words), "{reported:?}");
    }
    assert_eq!(lines(&["--silicon", "7"]), lines(&["--silicon", "7"]));
    let two = lines(&["--silicon", "7", "--node-count", "2"]);
    assert!(
        two[0].starts_with("board 1: silicon 7:") && two[1].starts_with("board 2: silicon 7:"),
        "{two:?}"
    );
    assert_ne!(two[0][7..], two[1][7..], "each board has a chip of its own");
}

#[test]
fn says_what_is_not_modelled_with_address_and_program_counter() {
    let image = program(&folder("unmodelled"), "reads_can2");
    let text = prints(&[&image, "--speed", "max", "--for", "0.01"]);
    let line = text.lines().nth(1).unwrap_or_default();
    assert!(line.contains("read of 4 bytes at 40006800h, pc 0800000Ah"), "{text}");
    assert!(text.contains("board: 1 accesses, in 1 places"), "{text}");
}

#[test]
fn refuses_with_a_reason() {
    let folder = folder("refusals");
    let image = program(&folder, "forever");
    let file = |name: &str, bytes: &[u8]| {
        let path = folder.join(name);
        std::fs::write(&path, bytes).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let (empty, text, elf) = (
        file("empty.elf", b""),
        file("text.elf", b"not an image"),
        file("broken.elf", b"\x7FELF\x01\x01\x01\0 and then nothing"),
    );
    let bin = file("raw.bin", &[0; 16]);
    let hex = file("broken.hex", b":0400000001020304F2\n:04000");
    let outside = format!("{bin}@20000000");
    let at_the_end = format!("{bin}@080FFFF8");
    let no_address = format!("{bin}@flash");
    for (args, words) in [
        (&[][..], "name at least one image"),
        (&["/nowhere/image.elf"], "/nowhere/image.elf"),
        (&[&empty], "the file is empty"),
        (&[&text], "neither ELF nor Intel HEX"),
        (&[&elf], "broken.elf"),
        (&[&hex], "line 2"),
        (&[&outside], "20000000h"),
        (
            &[&at_the_end],
            "16 bytes at 080FFFF8h are not all in the flash of the STM32F407VG, which has 1024 KiB",
        ),
        (&[&no_address], "`flash` is not a hexadecimal address"),
        (&[&image, "--board", "nucleo"], "stm32f407g-disc1"),
        (&[&image, "--speed", "0"], "neither `max` nor a number"),
        (&[&image, "--for", "-1"], "--for"),
        (&[&image, "--for", "1e30"], "number of seconds"),
        (&[&image, "--bit-rate", "0"], "bit-rate"),
        (&[&image, "--silicon", "best"], "`typical`, `worst`, or a number"),
        (&[&image, "--silicon", "18446744073709551616"], "as a seed"),
        (&[&image, "--node-count", "0"], "node-count"),
        (&[&image, "--socketcand", "nonsense"], "cannot listen at nonsense"),
        (&[&image, "--trace", "/nowhere/trace.log"], "/nowhere/trace.log"),
        (&[&image, "--trace-errors"], "--trace"),
    ] {
        let output = emulate(args);
        let text = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success(), "{args:?}");
        assert!(text.contains(words), "{args:?}: {text}");
        assert!(!text.contains("panicked"), "{args:?}: {text}");
    }
}

#[test]
#[cfg(unix)]
fn serves_clients_until_ctrl_c() {
    let image = program(&folder("clients"), "forever");
    let mut board = Running::start(&[&image, "--socketcand", "127.0.0.1:0", "-v"]);
    let address = board.after("clients reach the bus at socketcand://");
    let address = address.strip_suffix("/can0").unwrap();
    let mut client = TcpStream::connect(address).unwrap();
    let mut buffer = [0; 64];
    let mut ask = |request: &[u8]| {
        client.write_all(request).unwrap();
        let len = client.read(&mut buffer).unwrap();
        String::from_utf8_lossy(&buffer[..len]).into_owned()
    };
    assert_eq!(ask(b""), "< hi >");
    assert_eq!(ask(b"< open can0 >"), "< ok >");
    assert_eq!(ask(b"< send 123 1 AB >< rawmode >"), "< ok >");
    // The program does not use its CAN controller, so no node acknowledges.
    let sent = board.line_with("123#AB");
    assert!(sent.contains("no acknowledge"), "{sent}");
    let last = board.interrupt();
    assert!(last.contains("end: 0 frames"), "{last}");
}

/// All bytes are the client's, and none is shown as text.
#[test]
#[cfg(unix)]
fn a_client_at_the_uart_gets_what_the_board_says() {
    let image = program(&folder("serial"), "says_u");
    let mut board = Running::start(&[&image, "--serial", "127.0.0.1:0"]);
    let mut client = TcpStream::connect(board.after("USART2 is at tcp://")).unwrap();
    client.set_read_timeout(Some(std::time::Duration::from_secs(20))).unwrap();
    let mut heard = [0; 1000];
    client.read_exact(&mut heard).unwrap();
    assert_eq!(heard, [b'U'; 1000]);
    drop(client);
    let last = board.interrupt();
    assert!(last.contains("end: 0 frames"), "{last}");
}

#[test]
fn a_reader_that_leaves_is_no_error() {
    let image = program(&folder("pipe"), "forever");
    let mut child = Command::new(env!("CARGO_BIN_EXE_emulate"))
        .args([&image, "--speed", "max", "--for", "0.1"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success());
    assert_eq!(String::from_utf8_lossy(&output.stderr), "");
}

/// An emulator that runs until it is dropped, and its output.
struct Running {
    child: std::process::Child,
    lines: std::io::Lines<BufReader<std::process::ChildStdout>>,
}

impl Running {
    fn start(args: &[&str]) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_emulate"))
            .args(args)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let lines = BufReader::new(child.stdout.take().unwrap()).lines();
        Self { child, lines }
    }

    /// Waits for the first line with this beginning; returns the rest of the line.
    fn after(&mut self, prefix: &str) -> String {
        let mut lines = self.lines.by_ref().map_while(Result::ok);
        lines.find_map(|line| line.strip_prefix(prefix).map(str::to_owned)).unwrap()
    }

    /// The first line that contains this.
    fn line_with(&mut self, words: &str) -> String {
        let mut lines = self.lines.by_ref().map_while(Result::ok);
        lines.find(|line| line.contains(words)).unwrap()
    }

    /// Ctrl-C, and the end; returns the last line.
    fn interrupt(mut self) -> String {
        let killed = Command::new("kill").args(["-INT", &self.child.id().to_string()]).status().unwrap();
        assert!(killed.success());
        let last = self.lines.by_ref().map_while(Result::ok).last().unwrap();
        assert!(self.child.wait().unwrap().success());
        last
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A client of the control socket.
struct Control(BufReader<TcpStream>);

impl Control {
    fn connect(address: &str) -> Self {
        Self(BufReader::new(TcpStream::connect(address).unwrap()))
    }

    fn ask(&mut self, bytes: &[u8]) -> String {
        self.0.get_mut().write_all(bytes).unwrap();
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }
}

const COMMANDS_AT: &str = "commands are taken at ";

#[test]
#[cfg(unix)]
fn the_control_socket_switches_power_and_takes_no_rubbish() {
    let image = program(&folder("control"), "forever");
    let mut board = Running::start(&[&image, "--control", "127.0.0.1:0"]);
    let address = board.after(COMMANDS_AT);
    let (mut one, mut other) = (Control::connect(&address), Control::connect(&address));
    let status = one.ask(b"status\n");
    assert!(status.starts_with("ok ") && status.contains("board: runs, pc 08000008h"), "{status}");
    assert!(other.ask(b"\x00\xFF rubbish\n").starts_with("error: "));
    assert!(other.ask(&[&[b'x'; 100_000][..], b"\n"].concat()).starts_with("error: a line has 255"));
    assert_eq!(one.ask(b"power off\n"), "ok power off");
    assert!(one.ask(b"status\n").contains("power off"));
    assert!(one.ask(b"reset\n").starts_with("error: its power is off"));
    assert!(one.ask(b"board 2 power on\n").starts_with("error: there is no board 2"));
    assert_eq!(one.ask(b"power on\n"), "ok power on");
    assert_eq!(one.ask(b"pin PC13 low\n"), "ok PC13 is low from outside");
    assert_eq!(one.ask(b"reset\n"), "ok reset by the pin NRST");
    board.line_with("board: reset by the pin NRST");
    board.interrupt();
}

#[test]
#[cfg(unix)]
fn the_flash_file_keeps_what_was_programmed() {
    let folder = folder("flash");
    let file = folder.join("flash.bin");
    let _ = std::fs::remove_file(&file);
    let path = file.to_str().unwrap();
    let image = program(&folder, "programs_a_byte");
    prints(&[&image, "--flash", path, "--speed", "max", "--for", "0.01"]);
    let kept = std::fs::read(&file).unwrap();
    assert_eq!(kept.len(), 1 << 20);
    assert_eq!(kept[..4], 0x2000_1000_u32.to_le_bytes());
    assert_eq!(kept[0x1_0000..0x1_0002], [0x00, 0xFF], "the program has programmed a byte");
    // The file holds the flash now, so no image is named; Ctrl-C and power off write it, too.
    std::fs::write(&file, [&kept[..0x1_0000], &[0xFF; 0xF_0000]].concat()).unwrap();
    let mut board = Running::start(&["--flash", path, "--control", "127.0.0.1:0"]);
    let address = board.after(COMMANDS_AT);
    board.line_with("power on");
    let mut control = Control::connect(&address);
    while control.ask(b"status\n").starts_with("ok 0.00") {}
    assert_eq!(control.ask(b"power off\n"), "ok power off");
    assert!(std::fs::read(&file).unwrap() == kept, "at power off");
    board.interrupt();
    assert!(std::fs::read(&file).unwrap() == kept, "at the end");
    assert!(!folder.join("flash.bin.new").exists());
    // A file that is no flash of this chip is not changed.
    std::fs::write(&file, [0; 1000]).unwrap();
    let output = emulate(&["--flash", path]);
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(!output.status.success() && text.contains("1000 bytes") && text.contains("1048576"), "{text}");
    assert_eq!(std::fs::read(&file).unwrap(), [0; 1000]);
    let output = emulate(&["--flash", "/nowhere/flash.bin", &image]);
    assert!(String::from_utf8(output.stderr).unwrap().contains("/nowhere/flash.bin cannot be written"));
}

/// A board with a debugger's port: its control socket, and the port's address.
fn for_gdb(image: &str) -> (Running, Control, String) {
    let mut board = Running::start(&[image, "--gdb", "127.0.0.1:0", "--control", "127.0.0.1:0"]);
    let control = Control::connect(&board.after(COMMANDS_AT));
    let address = board.after("gdb reaches the board by `target remote ").trim_end_matches('`').to_owned();
    (board, control, address)
}

/// The output of gdb.
fn gdb(address: &str, commands: &[&str]) -> String {
    let mut gdb = Command::new("gdb-multiarch");
    gdb.args(["-nx", "-batch", "-ex", "set architecture arm", "-ex", &format!("target remote {address}")]);
    for command in commands {
        gdb.args(["-ex", command]);
    }
    let output = gdb.stdin(Stdio::null()).output().unwrap_or_else(|error| {
        panic!("gdb-multiarch: {error}. `cargo xtask test` installs it (Debian's package gdb-multiarch).")
    });
    // gdb prints the answer to `monitor` on its standard error.
    [output.stderr, output.stdout].map(|text| String::from_utf8_lossy(&text).into_owned()).concat()
}

/// gdb with breakpoints, steps, memory, registers, and a reset; the virtual time is stopped while
/// the machine is halted.
#[test]
#[cfg(unix)]
fn gdb_stops_steps_looks_and_changes() {
    let image = program(&folder("gdb"), "counts");
    let (board, mut control, address) = for_gdb(&image);
    // Commands, and what they print.
    let steps = [
        ("monitor reset", ""),
        ("maintenance flush register-cache", ""),
        ("p/x $pc", "$1 = 0x8000008"),
        ("break *0x0800000c", ""),
        ("continue", "Breakpoint 1, 0x0800000c"),
        ("continue", "Breakpoint 1, 0x0800000c"),
        ("p $r0", "$2 = 1"),
        ("x/wx 0x20000000", "0x20000000:\t0x00000001"),
        ("delete", ""),
        ("hbreak *0x08000016", ""),
        ("continue", "Breakpoint 2, 0x08000016"),
        ("p/x $lr", "$3 = 0x8000015"),
        ("stepi", ""),
        ("p/x $pc", "$4 = 0x8000018"),
        ("stepi", ""),
        ("p/x $pc", "$5 = 0x8000014"),
        ("set var $r0 = 1000", ""),
        ("set var *(int*)0x20000010 = 0x12345678", ""),
        ("x/wx 0x20000010", "0x20000010:\t0x12345678"),
        // CPUID of the Cortex-M4 r0p1 (PM0214 section 4.4.2).
        ("x/wx 0xe000ed00", "0xe000ed00:\t0x410fc241"),
        ("delete", ""),
        ("break *0x0800000c", ""),
        ("continue", "Breakpoint 3, 0x0800000c"),
        ("p $r0", "$6 = 1000"),
        ("monitor rubbish", ""),
        ("detach", "detached"),
    ];
    let said = gdb(&address, &steps.map(|(command, _)| command));
    // The answers to `monitor` come first.
    let answers = ["halted at 08000008h", "known command: reset"];
    let mut rest = said.as_str();
    for words in answers.into_iter().chain(steps.map(|(_, words)| words)) {
        let at =
            rest.find(words).unwrap_or_else(|| panic!("{words:?} is missing behind {rest:?} in\n{said}"));
        rest = &rest[at + words.len()..];
    }
    assert!(control.ask(b"status\n").contains("board: runs"), "it goes on without its debugger");
    board.interrupt();
}

/// A packet of gdb's protocol.
const NOISE: &[u8] = b"$#+-cmMgGsXZzvqk,;:0123456789abcdef\x03\xFF}*";

/// While the machine is halted no time goes by. When a debugger disconnects at any point, the
/// machine goes on. Invalid bytes do no harm.
#[test]
#[cfg(unix)]
fn a_debugger_that_hangs_up_or_sends_rubbish_does_no_harm() {
    let image = program(&folder("gdb-rubbish"), "counts");
    let (mut board, mut control, address) = for_gdb(&image);
    let mut door = TcpStream::connect(&address).unwrap();
    board.line_with("time stands still");
    let status = control.ask(b"status\n");
    assert!(status.contains("halted by the debugger"), "{status}");
    assert_eq!(control.ask(b"status\n"), status, "time and all stand still");
    // A second debugger waits.
    let second = TcpStream::connect(&address).unwrap();
    // It asks for a step, and disconnects before the answer.
    door.write_all(b"$s#73").unwrap();
    drop(door);
    board.line_with("the board goes on");
    board.line_with("time stands still");
    drop(second);
    board.line_with("the board goes on");
    let mut random = 1_u32;
    for packet in
        [&b"$m08000000,ffffffff#00"[..], b"$G00#a7", b"$Z0,zz,9#11", b"$vCont;s:9;c#xx", b"\x03\x03$", b""]
    {
        let mut door = TcpStream::connect(&address).unwrap();
        board.line_with("time stands still");
        let noise: Vec<u8> = (0..4096)
            .map(|_| {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                NOISE[(random >> 16) as usize % NOISE.len()]
            })
            .collect();
        // The server may close the connection.
        let _ = door.write_all(packet).and_then(|()| door.write_all(&noise));
        drop(door);
        board.line_with("the board goes on");
    }
    assert!(control.ask(b"status\n").contains("board: runs"));
    board.interrupt();
}
