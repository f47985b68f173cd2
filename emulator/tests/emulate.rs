//! The `emulate` command as a person runs it, with programs of a few hand-assembled instructions.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

fn emulate(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_emulate")).args(args).output().expect("the command starts")
}

/// A folder of its own for each test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    std::fs::create_dir_all(&folder).unwrap();
    folder
}

/// Initial SP, reset vector, then `code` from 0800_0008 on.
fn program(folder: &Path, code: &[u16]) -> String {
    let mut bytes = Vec::new();
    bytes.extend(0x2000_1000_u32.to_le_bytes());
    bytes.extend(0x0800_0009_u32.to_le_bytes());
    bytes.extend(code.iter().flat_map(|half| half.to_le_bytes()));
    let path = folder.join("program.bin");
    std::fs::write(&path, bytes).unwrap();
    format!("{}@08000000", path.display())
}

/// b .
const FOREVER: &[u16] = &[0xE7FE];

/// ldr r0, [pc, #4]; ldr r1, [r0]; b .; nop; .word 4000_6800 (CAN2)
const READS_CAN2: &[u16] = &[0x4801, 0x6801, 0xE7FE, 0xBF00, 0x6800, 0x4000];

#[test]
fn runs_for_the_time_it_is_told() {
    let folder = folder("time");
    let trace = folder.join("trace.log");
    let image = program(&folder, FOREVER);
    let args =
        ["--bootloader", &image, "--speed", "max", "--for", "0.25", "--trace", trace.to_str().unwrap()];
    let output = emulate(&args);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(output.status.success(), "{text}");
    assert_eq!(text, "0.000000 board: power on\n0.250000 end: 0 frames, 0 error frames\n");
    assert_eq!(std::fs::read(trace).unwrap(), b"");
    let output = emulate(&[
        "--board",
        "stm32f407g-disc1",
        &image,
        "--speed",
        "max",
        "--for",
        "0.01",
        "--node-count",
        "2",
    ]);
    let text = String::from_utf8(output.stdout).unwrap();
    assert!(text.contains("board 1: power on") && text.contains("board 2: power on"), "{text}");
}

#[test]
fn says_what_is_not_modelled_with_address_and_program_counter() {
    let image = program(&folder("unmodelled"), READS_CAN2);
    let output = emulate(&[&image, "--speed", "max", "--for", "0.01"]);
    let text = String::from_utf8(output.stdout).unwrap();
    let line = text.lines().nth(1).unwrap_or_default();
    assert!(line.contains("read of 4 bytes at 40006800h, pc 0800000Ah"), "{text}");
    assert!(text.contains("board: 1 accesses, in 1 places"), "{text}");
}

#[test]
fn refuses_with_a_reason() {
    let folder = folder("refusals");
    let image = program(&folder, FOREVER);
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
        (&[&at_the_end], "080FFFF8h"),
        (&[&no_address], "`flash` is not a hexadecimal address"),
        (&[&image, "--board", "nucleo"], "stm32f407g-disc1"),
        (&[&image, "--speed", "0"], "neither `max` nor a number"),
        (&[&image, "--for", "-1"], "--for"),
        (&[&image, "--for", "1e30"], "number of seconds"),
        (&[&image, "--bit-rate", "0"], "bit-rate"),
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
    let image = program(&folder("clients"), FOREVER);
    let mut child = Command::new(env!("CARGO_BIN_EXE_emulate"))
        .args([&image, "--socketcand", "127.0.0.1:0", "-v"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let first = lines.next().unwrap();
    let address = first.strip_prefix("clients reach the bus at socketcand://").unwrap();
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
    // The program never touches its CAN controller, so nobody acknowledges.
    let told = lines.by_ref().find(|line| line.contains("123#AB")).unwrap();
    assert!(told.contains("no acknowledge"), "{told}");
    let killed = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(killed.success());
    let last = lines.last().unwrap();
    assert!(last.contains("end: 0 frames"), "{last}");
    assert!(child.wait().unwrap().success());
}

#[test]
fn a_reader_that_leaves_is_no_error() {
    let image = program(&folder("pipe"), FOREVER);
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
