//! Parses RADV's assembly. Only those of AMD's instructions are known that the kernels use. Any other instruction is a
//! panic that names it.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::ops::Range;

/// The location of an operand.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Place {
    /// The first of several consecutive vector registers, and their number.
    Vector(usize, usize),
    /// The same for scalar registers.
    Scalar(usize, usize),
    /// The value as 32 and as 64 bits.
    Constant(u32, u64),
    /// The scalar condition code (SCC).
    Condition,
}

/// Numbers of all registers: vector registers from 0, scalar registers from `SCALAR`, and the condition code.
pub const SCALAR: usize = 256;
pub const CONDITION: usize = SCALAR + 128;

/// Scalar registers with names: VCC has the result mask of comparisons, and EXEC the mask of active lanes.
const VCC: usize = 106;
pub const EXEC: usize = 126;
const NAMED: [(&str, Place); 9] = [
    ("vcc", Place::Scalar(VCC, 2)),
    ("vcc_lo", Place::Scalar(VCC, 1)),
    ("vcc_hi", Place::Scalar(VCC + 1, 1)),
    ("exec", Place::Scalar(EXEC, 2)),
    ("exec_lo", Place::Scalar(EXEC, 1)),
    ("exec_hi", Place::Scalar(EXEC + 1, 1)),
    ("null", Place::Constant(0, 0)),
    ("off", Place::Constant(0, 0)),
    ("src_scc", Place::Condition),
];

/// An operand. For floats, `absolute` is applied before `negative`.
#[derive(Clone, Copy, Debug)]
pub struct Operand {
    pub place: Place,
    pub negative: bool,
    pub absolute: bool,
}

impl Operand {
    fn parse(text: &str) -> Option<Operand> {
        if let Some(place) = constant(text) {
            return Some(Operand { place, negative: false, absolute: false });
        }
        let (negative, rest) = text.strip_prefix('-').map_or((false, text), |rest| (true, rest));
        let bare = rest.trim_matches('|');
        let named = NAMED.into_iter().find(|(name, _)| *name == bare).map(|(_, place)| place);
        Some(Operand { place: named.or_else(|| registers(bare))?, negative, absolute: bare != rest })
    }

    /// Returns the numbers of its registers.
    pub fn registers(&self) -> Range<usize> {
        match self.place {
            Place::Vector(first, count) => first..first + count,
            Place::Scalar(first, count) => SCALAR + first..SCALAR + first + count,
            Place::Condition => CONDITION..CONDITION + 1,
            Place::Constant(..) => 0..0,
        }
    }

    /// Returns its first vector register.
    pub fn vector(&self) -> usize {
        let Place::Vector(first, _) = self.place else { panic!("{self:?} is not a vector register") };
        first
    }

    /// Returns its first scalar register.
    pub fn scalar(&self) -> usize {
        let Place::Scalar(first, _) = self.place else { panic!("{self:?} is not a scalar register") };
        first
    }
}

/// Parses `7`, `-7`, `0x7f` and `0.5`. As 64 bits, integers are sign-extended, and floats are doubles.
fn constant(text: &str) -> Option<Place> {
    if let Some(hex) = text.strip_prefix("0x") {
        return u32::from_str_radix(hex, 16).ok().map(|bits| Place::Constant(bits, bits.into()));
    }
    if let Ok(integer) = text.parse::<i64>() {
        return Some(Place::Constant(integer as u32, integer as u64));
    }
    let float: f64 = text.contains('.').then(|| text.parse().ok())??;
    Some(Place::Constant((float as f32).to_bits(), float.to_bits()))
}

/// Parses `s7` and `v[4:7]`.
fn registers(text: &str) -> Option<Place> {
    let kind = text.get(..1)?;
    let (first, last) = match text[1..].strip_prefix('[') {
        Some(range) => range.strip_suffix(']')?.split_once(':')?,
        None => (&text[1..], &text[1..]),
    };
    let (first, last): (usize, usize) = (first.parse().ok()?, last.parse().ok()?);
    match kind {
        "v" => Some(Place::Vector(first, last + 1 - first)),
        "s" => Some(Place::Scalar(first, last + 1 - first)),
        _ => None,
    }
}

/// The operation of an instruction. The comments give the order of its operands.
#[derive(Clone, Copy)]
pub enum Action {
    /// A result and up to three inputs, per lane. The flag says whether the operation rounds.
    Lanes(fn([u32; 3]) -> u32, bool),
    /// A result and two inputs, per lane. The result register is the third input.
    Accumulates(fn([u32; 3]) -> u32),
    /// A result mask, which RDNA's `cmpx` does not have, and two inputs. The flag says whether only lanes for which the
    /// comparison holds stay active.
    Compare(fn(u32, u32) -> bool, bool),
    Select,
    /// The sum, the carries out, two inputs, and the carries in.
    AddWithCarry,
    ShiftWide,
    Swap,
    FirstLane,
    /// A scalar register from one lane of a vector register, and the other way.
    ReadLane,
    WriteLane,
    /// A result and two inputs. The flag says whether they have 64 bits. The last field is the new condition code.
    Scalar(fn(u64, u64) -> u64, bool, Change),
    ScalarCompare(fn(u32, u32) -> bool),
    ScalarSelect(bool),
    /// A register for the old mask of active lanes, and the mask of lanes that stay active.
    SaveLanes,
    LoadDescriptor,
    LoadScalars,
    Load,
    Store,
    /// The number of words per address. If the instruction has two addresses, the second field is the unit of their
    /// offsets, in words.
    LocalLoad(usize, Option<usize>),
    LocalStore(usize),
    Branch(When),
    Wait(Option<usize>, Option<usize>),
    Barrier,
    Nothing,
    End,
}

/// The condition of a branch.
#[derive(Clone, Copy)]
pub enum When {
    Always,
    Condition(bool),
    /// No lane is active.
    Empty,
}

/// The way in which a scalar instruction sets the condition code.
#[derive(Clone, Copy)]
pub enum Change {
    Kept,
    NotZero,
    Carry,
    /// Set if a signed sum overflows.
    Overflow,
    /// Set if a signed difference overflows.
    OverflowDown,
}

pub struct Instruction {
    pub text: String,
    pub action: Action,
    pub operands: Vec<Operand>,
    /// An offset in memory, in bytes.
    pub offset: u32,
    /// The offsets of an instruction with two addresses, in the unit of its [`Action::LocalLoad`].
    pub offsets: [u32; 2],
    /// Whether each lane has its own address.
    pub addressed: bool,
    /// A factor by which a float result is multiplied: 2, 4 or 1/2.
    pub scale: Option<f32>,
    /// The index of the instruction to which it branches.
    pub target: usize,
    /// The factor by which it takes longer than other vector instructions.
    pub issues: u64,
    pub is_vector: bool,
    /// The numbers of the registers that it reads and writes.
    pub reads: Vec<usize>,
    pub writes: Vec<usize>,
}

pub struct Program(pub Vec<Instruction>);

impl Program {
    /// Parses the assembly of a shader.
    pub fn parse(assembly: &str, family: &str) -> Program {
        let (mut labels, mut last) = (HashMap::new(), "");
        let mut instructions: Vec<(Instruction, Option<String>)> = Vec::new();
        for line in assembly.lines() {
            let text = line.split(';').next().unwrap_or_default().trim();
            if text.is_empty() {
                continue;
            }
            if let Some(label) = text.strip_suffix(':') {
                labels.insert(label.to_string(), instructions.len());
            } else if text.starts_with("(then repeated") {
                let times: usize = text.split(' ').find_map(|word| word.parse().ok()).expect("a number of repetitions");
                instructions.extend((0..times).map(|_| instruction(last, family)));
            } else {
                instructions.push(instruction(text, family));
                last = text;
            }
        }
        let resolved = instructions.into_iter().map(|(mut instruction, label)| {
            if let Some(label) = label {
                instruction.target = labels[&label];
            }
            instruction
        });
        Program(resolved.collect())
    }
}

/// Parses one line. Returns the instruction, and the label to which it branches.
fn instruction(text: &str, family: &str) -> (Instruction, Option<String>) {
    let (name, rest) = text.split_once(' ').unwrap_or((text, ""));
    let action = action(name, rest).unwrap_or_else(|| panic!("{family}: unknown instruction `{text}`"));
    let mut parsed = Instruction {
        text: text.to_string(),
        action,
        operands: Vec::new(),
        offset: 0,
        offsets: [0, 0],
        addressed: false,
        scale: None,
        target: 0,
        issues: if name.starts_with("v_mul_lo") || name.starts_with("v_mul_hi") { 4 } else { 1 },
        is_vector: name.starts_with("v_"),
        reads: Vec::new(),
        writes: Vec::new(),
    };
    if matches!(action, Action::Wait(..) | Action::Nothing | Action::Barrier | Action::End) {
        return (parsed, None);
    }
    if let Action::Branch(when) = action {
        parsed.reads = match when {
            When::Always => Vec::new(),
            When::Condition(_) => vec![CONDITION],
            When::Empty => vec![SCALAR + EXEC, SCALAR + EXEC + 1],
        };
        return (parsed, Some(rest.trim().to_string()));
    }
    for word in rest.split([',', ' ']).filter(|word| !word.is_empty()) {
        let number = |text: &str| match constant(text) {
            Some(Place::Constant(bits, _)) => bits,
            _ => panic!("{text} in `{}` is not a number", parsed.text),
        };
        match word.split_once(':') {
            Some(("offset", offset)) => parsed.offset = number(offset),
            Some(("offset0", offset)) => parsed.offsets[0] = number(offset),
            Some(("offset1", offset)) => parsed.offsets[1] = number(offset),
            Some(("mul", by)) => parsed.scale = Some(number(by) as f32),
            Some(("div", by)) => parsed.scale = Some(1.0 / number(by) as f32),
            None if word == "offen" => parsed.addressed = true,
            None if ["glc", "slc", "dlc"].contains(&word) => (),
            _ => parsed
                .operands
                .push(Operand::parse(word).unwrap_or_else(|| panic!("unknown operand {word} in `{text}`"))),
        }
    }
    // The constants of s_movk, s_mulk and s_addk have 16 bits and a sign.
    if let ["s", kind, ..] = name.split('_').collect::<Vec<_>>()[..]
        && ["movk", "mulk", "addk"].contains(&kind)
        && let Some(Operand { place: Place::Constant(bits, wide), .. }) = parsed.operands.last_mut()
    {
        (*bits, *wide) = (*bits as i16 as u32, *bits as i16 as u64);
        if kind != "movk" {
            parsed.operands.insert(1, parsed.operands[0]);
        }
    }
    parsed.find_dependencies();
    (parsed, None)
}

impl Instruction {
    /// Fills `reads` and `writes`.
    fn find_dependencies(&mut self) {
        use Action::*;
        let registers = |operands: &[Operand]| -> Vec<usize> { operands.iter().flat_map(Operand::registers).collect() };
        let operands = &self.operands[..];
        let written = match self.action {
            Store | LocalStore(_) | ScalarCompare(_) => 0,
            Compare(..) if operands.len() == 2 => 0,
            AddWithCarry | Swap => 2,
            _ => 1,
        };
        (self.writes, self.reads) = (registers(&operands[..written]), registers(&operands[written..]));
        let lanes = [SCALAR + EXEC, SCALAR + EXEC + 1];
        match self.action {
            Swap | Accumulates(_) => self.reads.extend(registers(&operands[..written])),
            Scalar(.., Change::Kept) => (),
            Scalar(..) | ScalarCompare(_) => self.writes.push(CONDITION),
            ScalarSelect(_) => self.reads.push(CONDITION),
            SaveLanes => {
                self.reads.extend(lanes);
                self.writes.extend(lanes);
                self.writes.push(CONDITION);
            }
            Compare(_, true) => self.writes.extend(lanes),
            _ => (),
        }
        if self.is_vector {
            self.reads.extend(lanes);
        }
    }
}

/// Returns the float with these bits.
pub fn f(bits: u32) -> f32 {
    f32::from_bits(bits)
}

/// Returns the operation of an instruction with this name.
fn action(name: &str, rest: &str) -> Option<Action> {
    if let Some(name) = name.strip_prefix("v_") {
        return vector_action(name.trim_end_matches("_e32").trim_end_matches("_e64"));
    }
    if let Some(name) = name.strip_prefix("buffer_") {
        return Some(if name.starts_with("load") { Action::Load } else { Action::Store })
            .filter(|_| words(name).is_some());
    }
    if let Some(name) = name.strip_prefix("ds_") {
        let words = words(name)?;
        return match name.rsplit_once('_')?.0 {
            "load" | "read" => Some(Action::LocalLoad(words, None)),
            // The offsets of two addresses count elements, or 64 elements.
            "load_2addr" | "read2" => Some(Action::LocalLoad(words, Some(words))),
            "load_2addr_stride64" | "read2st64" => Some(Action::LocalLoad(words, Some(64 * words))),
            "store" | "write" => Some(Action::LocalStore(words)),
            _ => None,
        };
    }
    let name = name.strip_prefix("s_")?;
    if name.starts_with("waitcnt") {
        let count = |what: &str| {
            let (_, rest) = rest.split_once(&format!("{what}("))?;
            rest.split(')').next()?.parse().ok()
        };
        return Some(Action::Wait(count("vmcnt"), count("lgkmcnt")));
    }
    match name {
        "endpgm" => Some(Action::End),
        "barrier" => Some(Action::Barrier),
        "clause" | "sendmsg" => Some(Action::Nothing),
        "branch" => Some(Action::Branch(When::Always)),
        "cbranch_scc0" => Some(Action::Branch(When::Condition(false))),
        "cbranch_scc1" => Some(Action::Branch(When::Condition(true))),
        "cbranch_execz" => Some(Action::Branch(When::Empty)),
        _ if name.starts_with("buffer_load") => words(name).map(|_| Action::LoadScalars),
        _ if name.starts_with("load") => words(name).map(|_| Action::LoadDescriptor),
        _ => scalar_action(name),
    }
}

/// Returns the words that a load or store transfers per address, according to the end of its name.
fn words(name: &str) -> Option<usize> {
    match name.rsplit('_').next()? {
        "dword" | "b32" => Some(1),
        "dwordx2" | "b64" => Some(2),
        "dwordx3" | "b96" => Some(3),
        "dwordx4" | "b128" => Some(4),
        _ => None,
    }
}

/// Returns the comparison of two signed or unsigned integers.
fn integer_comparison(kind: &str, relation: &str) -> Option<fn(u32, u32) -> bool> {
    Some(match (kind, relation) {
        ("i32", "lt") => |a, b| (a as i32) < b as i32,
        ("i32", "ge") => |a, b| a as i32 >= b as i32,
        ("i32", "gt") => |a, b| a as i32 > b as i32,
        ("i32", "le") => |a, b| a as i32 <= b as i32,
        ("u32", "lt") => |a, b| a < b,
        ("u32", "le") => |a, b| a <= b,
        ("u32", "gt") => |a, b| a > b,
        ("u32", "ge") => |a, b| a >= b,
        ("i32", "eq") => |a, b| a == b,
        ("i32", "ne" | "lg") => |a, b| a != b,
        _ => return None,
    })
}

fn vector_action(name: &str) -> Option<Action> {
    use Action::{Accumulates, Compare, Lanes};
    let float = |work| Some(Lanes(work, true));
    let integer = |work| Some(Lanes(work, false));
    if let Some(comparison) = name.strip_prefix("cmp") {
        let (narrows, comparison) = comparison.strip_prefix('x').map_or((false, comparison), |rest| (true, rest));
        let (relation, kind) = comparison.strip_prefix('_')?.split_once('_')?;
        let holds: fn(u32, u32) -> bool = match (kind, relation) {
            ("f32", "nlt") => |a, b| f(a).partial_cmp(&f(b)) != Some(Ordering::Less),
            ("f32", "ngt") => |a, b| f(a).partial_cmp(&f(b)) != Some(Ordering::Greater),
            ("f32", "eq") => |a, b| f(a) == f(b),
            ("f32", "lt") => |a, b| f(a) < f(b),
            ("f32", "le") => |a, b| f(a) <= f(b),
            ("f32", "gt") => |a, b| f(a) > f(b),
            ("f32", "ge") => |a, b| f(a) >= f(b),
            _ => integer_comparison(kind, relation)?,
        };
        return Some(Compare(holds, narrows));
    }
    match name {
        "mul_f32" => float(|[a, b, _]| (f(a) * f(b)).to_bits()),
        "add_f32" => float(|[a, b, _]| (f(a) + f(b)).to_bits()),
        "sub_f32" => float(|[a, b, _]| (f(a) - f(b)).to_bits()),
        // These round the product and the sum.
        "mad_f32" | "madak_f32" | "madmk_f32" => float(|[a, b, c]| (f(a) * f(b) + f(c)).to_bits()),
        "mac_f32" => Some(Accumulates(|[a, b, c]| (f(a) * f(b) + f(c)).to_bits())),
        "fma_f32" | "fmaak_f32" | "fmamk_f32" => float(|[a, b, c]| f(a).mul_add(f(b), f(c)).to_bits()),
        "fmac_f32" => Some(Accumulates(|[a, b, c]| f(a).mul_add(f(b), f(c)).to_bits())),
        "max_f32" => float(|[a, b, _]| f(a).max(f(b)).to_bits()),
        "min_f32" => float(|[a, b, _]| f(a).min(f(b)).to_bits()),
        "med3_f32" => float(|[a, b, c]| f(a).min(f(b)).max(f(a).max(f(b)).min(f(c))).to_bits()),
        "floor_f32" => float(|[a, ..]| f(a).floor().to_bits()),
        // Chips may err by a unit in the last place. The compiler uses this for integer division, and corrects the
        // result.
        "rcp_f32" | "rcp_iflag_f32" => float(|[a, ..]| (1.0 / f(a)).to_bits()),
        "cvt_f32_u32" => float(|[a, ..]| (a as f32).to_bits()),
        // Rounds towards zero and saturates, like `as`.
        "cvt_u32_f32" => integer(|[a, ..]| f(a) as u32),
        "mov_b32" => integer(|[a, ..]| a),
        "not_b32" => integer(|[a, ..]| !a),
        "and_b32" => integer(|[a, b, _]| a & b),
        "or_b32" => integer(|[a, b, _]| a | b),
        "or3_b32" => integer(|[a, b, c]| a | b | c),
        "add_u32" | "add_nc_u32" => integer(|[a, b, _]| a.wrapping_add(b)),
        "sub_u32" | "sub_nc_u32" => integer(|[a, b, _]| a.wrapping_sub(b)),
        "subrev_u32" | "subrev_nc_u32" => integer(|[a, b, _]| b.wrapping_sub(a)),
        "add3_u32" => integer(|[a, b, c]| a.wrapping_add(b).wrapping_add(c)),
        "add_lshl_u32" => integer(|[a, b, c]| a.wrapping_add(b) << (c & 31)),
        "lshl_add_u32" => integer(|[a, b, c]| (a << (b & 31)).wrapping_add(c)),
        "lshlrev_b32" => integer(|[a, b, _]| b << (a & 31)),
        "lshrrev_b32" => integer(|[a, b, _]| b >> (a & 31)),
        "ashrrev_i32" => integer(|[a, b, _]| (b as i32 >> (a & 31)) as u32),
        "bfrev_b32" => integer(|[a, ..]| a.reverse_bits()),
        "max_i32" => integer(|[a, b, _]| (a as i32).max(b as i32) as u32),
        "min_i32" => integer(|[a, b, _]| (a as i32).min(b as i32) as u32),
        "cvt_f32_i32" => float(|[a, ..]| (a as i32 as f32).to_bits()),
        "bfe_u32" => integer(|[a, b, c]| a >> (b & 31) & ((1u32 << (c & 31)) - 1)),
        "max_u32" => integer(|[a, b, _]| a.max(b)),
        "min_u32" => integer(|[a, b, _]| a.min(b)),
        "mul_lo_u32" => integer(|[a, b, _]| a.wrapping_mul(b)),
        "mul_hi_u32" => integer(|[a, b, _]| ((u64::from(a) * u64::from(b)) >> 32) as u32),
        "mad_u32_u24" => integer(|[a, b, c]| (a & 0xff_ffff).wrapping_mul(b & 0xff_ffff).wrapping_add(c)),
        // The index of the lowest set bit, or all ones.
        "ffbl_b32" | "ctz_i32_b32" => integer(|[a, ..]| if a == 0 { u32::MAX } else { a.trailing_zeros() }),
        "cndmask_b32" => Some(Action::Select),
        "addc_co_u32" | "add_co_ci_u32" => Some(Action::AddWithCarry),
        "lshrrev_b64" => Some(Action::ShiftWide),
        "swap_b32" => Some(Action::Swap),
        "readfirstlane_b32" => Some(Action::FirstLane),
        "readlane_b32" => Some(Action::ReadLane),
        "writelane_b32" => Some(Action::WriteLane),
        _ => None,
    }
}

fn scalar_action(name: &str) -> Option<Action> {
    use Change::{Carry, Kept, NotZero, Overflow, OverflowDown};
    let wide = name.ends_with("64");
    let (stem, kind) = name.rsplit_once('_')?;
    if let Some(relation) = stem.strip_prefix("cmp_") {
        return integer_comparison(kind, relation).map(Action::ScalarCompare);
    }
    let scalar = |work, condition| Some(Action::Scalar(work, wide, condition));
    match (stem, kind) {
        ("mov", "b32" | "b64") => scalar(|a, _| a, Kept),
        ("movk", "i32") => scalar(|a, _| a, Kept),
        ("not", "b32" | "b64") => scalar(|a, _| !a, NotZero),
        ("and", "b32" | "b64") => scalar(|a, b| a & b, NotZero),
        ("or", "b32" | "b64") => scalar(|a, b| a | b, NotZero),
        ("xor", "b32" | "b64") => scalar(|a, b| a ^ b, NotZero),
        ("andn2" | "and_not1", "b32" | "b64") => scalar(|a, b| a & !b, NotZero),
        ("orn2" | "or_not1", "b32" | "b64") => scalar(|a, b| a | !b, NotZero),
        ("add", "u32") => scalar(|a, b| a + b, Carry),
        ("add" | "addk", "i32") => scalar(|a, b| a.wrapping_add(b), Overflow),
        ("sub", "i32") => scalar(|a, b| a.wrapping_sub(b), OverflowDown),
        ("mul" | "mulk", "i32") => scalar(|a, b| a.wrapping_mul(b), Kept),
        ("mul_hi", "u32") => scalar(|a, b| (a * b) >> 32, Kept),
        ("lshl", "b32") => scalar(|a, b| a << (b & 31), NotZero),
        ("lshr", "b32") => scalar(|a, b| a >> (b & 31), NotZero),
        ("ashr", "i32") => scalar(|a, b| (a as i32 >> (b & 31)) as u32 as u64, NotZero),
        ("lshl1_add", "u32") => scalar(|a, b| (a << 1) + b, Carry),
        ("lshl3_add", "u32") => scalar(|a, b| (a << 3) + b, Carry),
        ("min", "u32") => scalar(|a, b| a.min(b), Kept),
        ("min", "i32") => scalar(|a, b| (a as i32).min(b as i32) as u32 as u64, Kept),
        ("max", "i32") => scalar(|a, b| (a as i32).max(b as i32) as u32 as u64, Kept),
        ("max", "u32") => scalar(|a, b| a.max(b), Kept),
        ("cselect", "b32" | "b64") => Some(Action::ScalarSelect(wide)),
        ("and_saveexec", _) => Some(Action::SaveLanes),
        _ => None,
    }
}
