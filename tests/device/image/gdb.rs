//! gdb with a stub of a target that has only memory (the GDB manual, appendix E: Remote Serial
//! Protocol).

use std::collections::BTreeMap;
use std::io::{BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::process::Command;
use std::thread;

use coboot_tests::firmware;

/// The results of a run of gdb.
pub struct Run {
    /// Its output.
    pub said: String,
    memory: BTreeMap<u32, u8>,
}

impl Run {
    /// The memory from an address on; unwritten bytes read as erased flash.
    pub fn memory(&self, address: u32, len: usize) -> Vec<u8> {
        read(&self.memory, address, len)
    }

    /// The addresses that were written.
    pub fn written(&self) -> impl Iterator<Item = u32> + '_ {
        self.memory.keys().copied()
    }
}

fn read(memory: &BTreeMap<u32, u8>, address: u32, len: usize) -> Vec<u8> {
    (address..).take(len).map(|address| memory.get(&address).copied().unwrap_or(0xFF)).collect()
}

/// Runs gdb with an ELF file, these commands and a target.
pub fn run(elf: &Path, commands: &[&str]) -> Run {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let stub = thread::spawn(move || Stub::serve(&listener));
    let mut gdb = Command::new("gdb-multiarch");
    gdb.args(["-nx", "-batch", "-ex", &format!("target remote {address}")]);
    for command in commands {
        gdb.args(["-ex", command]);
    }
    let output = gdb.arg(elf).output();
    let output = output.unwrap_or_else(|error| {
        panic!("gdb-multiarch: {error}. `cargo xtask test` installs it (Debian's package gdb-multiarch).")
    });
    let said =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    Run { said, memory: stub.join().unwrap() }
}

/// The target's side.
struct Stub {
    from: BufReader<TcpStream>,
    to: TcpStream,
    memory: BTreeMap<u32, u8>,
}

/// A Cortex-M with only the features that `load` needs.
const TARGET: &str = r#"<target><architecture>arm</architecture><feature name="org.gnu.gdb.arm.m-profile">
<reg name="r0" bitsize="32"/><reg name="r1" bitsize="32"/><reg name="r2" bitsize="32"/><reg name="r3" bitsize="32"/>
<reg name="r4" bitsize="32"/><reg name="r5" bitsize="32"/><reg name="r6" bitsize="32"/><reg name="r7" bitsize="32"/>
<reg name="r8" bitsize="32"/><reg name="r9" bitsize="32"/><reg name="r10" bitsize="32"/><reg name="r11" bitsize="32"/>
<reg name="r12" bitsize="32"/><reg name="sp" bitsize="32"/><reg name="lr" bitsize="32"/><reg name="pc" bitsize="32"/>
<reg name="xpsr" bitsize="32"/></feature></target>"#;

impl Stub {
    /// Serves one gdb until it disconnects; returns the memory.
    fn serve(listener: &TcpListener) -> BTreeMap<u32, u8> {
        let (to, _) = listener.accept().unwrap();
        to.set_nodelay(true).unwrap();
        let from = BufReader::new(to.try_clone().unwrap());
        let mut stub = Self { from, to, memory: BTreeMap::new() };
        while let Some(packet) = stub.packet() {
            let answer = stub.answer(&packet);
            let sum = answer.bytes().fold(0_u8, u8::wrapping_add);
            if write!(stub.to, "+${answer}#{sum:02x}").is_err() {
                break;
            }
        }
        stub.memory
    }

    fn byte(&mut self) -> Option<u8> {
        let mut byte = [0];
        self.from.read_exact(&mut byte).ok().map(|()| byte[0])
    }

    /// The contents of the next packet, unescaped.
    fn packet(&mut self) -> Option<Vec<u8>> {
        while self.byte()? != b'$' {}
        let mut packet = Vec::new();
        loop {
            match self.byte()? {
                b'#' => break,
                b'}' => packet.push(self.byte()? ^ 0x20),
                byte => packet.push(byte),
            }
        }
        // The checksum is not checked: the connection is reliable.
        self.byte()?;
        self.byte()?;
        Some(packet)
    }

    fn answer(&mut self, packet: &[u8]) -> String {
        let text = String::from_utf8_lossy(packet).into_owned();
        let numbers = |text: &str| -> Vec<u32> {
            text.split([',', ':']).map_while(|number| u32::from_str_radix(number, 16).ok()).collect()
        };
        let flash = firmware::board().chip.flash;
        if text.starts_with("qSupported") {
            return "PacketSize=1000;qXfer:memory-map:read+;qXfer:features:read+".into();
        }
        if text.starts_with("qXfer:features:read:target.xml:0,") {
            return format!("l{TARGET}");
        }
        if text.starts_with("qXfer:memory-map:read::0,") {
            let ram = firmware::board().chip.sram;
            return format!(
                "l<memory-map><memory type=\"flash\" start=\"{:#x}\" length=\"{:#x}\"><property \
                 name=\"blocksize\">0x4000</property></memory><memory type=\"ram\" start=\"{:#x}\" \
                 length=\"{:#x}\"/></memory-map>",
                flash.base, flash.size, ram.base, ram.size
            );
        }
        if let Some(arguments) = text.strip_prefix("vFlashErase:") {
            let [address, size] = numbers(arguments)[..] else { return "E01".into() };
            self.memory.retain(|at, _| *at < address || *at >= address + size);
            return "OK".into();
        }
        if let Some(arguments) = text.strip_prefix("vFlashWrite:") {
            let data = packet.splitn(3, |byte| *byte == b':').nth(2).unwrap_or_default();
            let Some(address) = numbers(arguments).first().copied() else { return "E01".into() };
            self.memory.extend((address..).zip(data.iter().copied()));
            return "OK".into();
        }
        match packet.first() {
            Some(b'?') => "S05".into(),
            Some(b'g') => "0".repeat(17 * 8),
            Some(b'p') => "0".repeat(8),
            Some(b'm') => {
                let [address, len] = numbers(&text[1..])[..] else { return "E01".into() };
                read(&self.memory, address, len as usize).iter().map(|byte| format!("{byte:02x}")).collect()
            }
            // Memory is written in binary; flash has its own packets.
            Some(b'X') => {
                let data = packet.splitn(2, |byte| *byte == b':').nth(1).unwrap_or_default();
                let address = numbers(&text[1..])[0];
                if flash.contains(address, 1) {
                    return "E01".into();
                }
                self.memory.extend((address..).zip(data.iter().copied()));
                "OK".into()
            }
            Some(b'P' | b'G' | b'H' | b'D' | b'k') => "OK".into(),
            _ if text == "vFlashDone" => "OK".into(),
            _ if text == "qAttached" => "1".into(),
            // Everything else is unsupported, which an empty answer means.
            _ => String::new(),
        }
    }
}
