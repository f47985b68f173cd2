//! Which register a load or store of one register moves, and where (DDI 0403E A5.2.4, A5.3.7 to
//! A5.3.10).

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Access {
    pub load: bool,
    /// The register that is loaded or stored.
    pub register: usize,
    /// Bytes.
    pub size: u32,
    pub address: u32,
    /// The base register with its new value, if it gets one.
    pub write_back: Option<(usize, u32)>,
    /// Of the instruction, in bytes.
    pub len: u32,
}

fn field(word: u16, shift: u32, bits: u32) -> usize {
    usize::from(word >> shift & ((1 << bits) - 1))
}

/// An instruction of 16 bits.
fn narrow(code: u16, registers: &[u32; 17]) -> Option<Access> {
    let base = registers[field(code, 3, 3)];
    let offset = field(code, 6, 5) as u32;
    let (load, size, address) = match code >> 11 {
        0b01010 | 0b01011 => {
            let (load, size) =
                [(false, 4), (false, 2), (false, 1), (true, 1), (true, 4), (true, 2), (true, 1), (true, 2)]
                    [field(code, 9, 3)];
            (load, size, base.wrapping_add(registers[field(code, 6, 3)]))
        }
        0b01100 => (false, 4, base.wrapping_add(4 * offset)),
        0b01101 => (true, 4, base.wrapping_add(4 * offset)),
        0b01110 => (false, 1, base.wrapping_add(offset)),
        0b01111 => (true, 1, base.wrapping_add(offset)),
        0b10000 => (false, 2, base.wrapping_add(2 * offset)),
        0b10001 => (true, 2, base.wrapping_add(2 * offset)),
        _ => return None,
    };
    Some(Access { load, register: field(code, 0, 3), size, address, write_back: None, len: 2 })
}

/// An instruction of 32 bits.
fn wide(first: u16, second: u16, registers: &[u32; 17]) -> Option<Access> {
    let base = field(first, 0, 4);
    if first & 0xFE00 != 0xF800 || field(first, 5, 2) == 3 || base == 15 {
        return None;
    }
    let from = registers[base];
    let mut write_back = None;
    let address = if field(first, 7, 1) == 1 {
        from.wrapping_add(field(second, 0, 12) as u32)
    } else if field(second, 11, 1) == 0 {
        from.wrapping_add(registers[field(second, 0, 4)] << field(second, 4, 2))
    } else {
        let offset = field(second, 0, 8) as u32;
        let there = from.wrapping_add(if field(second, 9, 1) == 1 { offset } else { offset.wrapping_neg() });
        if field(second, 8, 1) == 1 {
            write_back = Some((base, there));
        }
        if field(second, 10, 1) == 1 {
            there
        } else {
            from
        }
    };
    Some(Access {
        load: field(first, 4, 1) == 1,
        register: field(second, 12, 4),
        size: 1 << field(first, 5, 2),
        address,
        write_back,
        len: 4,
    })
}

/// The access that the instruction makes whose first four bytes these are.
pub fn of(code: &[u8], registers: &[u32; 17]) -> Option<Access> {
    let [first, second] = [0, 2].map(|at| u16::from_le_bytes([code[at], code[at + 1]]));
    if first >> 11 >= 0b11101 {
        wide(first, second, registers)
    } else {
        narrow(first, registers)
    }
}
