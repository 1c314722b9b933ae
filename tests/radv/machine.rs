//! Runs what RADV wrote for one workgroup of a chip that is not there, and counts what that costs.
//!
//! Written by AMD's manuals of the Vega, RDNA 2 and RDNA 3 instruction sets, for as much of them as these kernels take:
//! whatever else turns up is a panic that names it. Floats round to nearest; a result that the chip would flush to zero
//! is counted, since then nothing of it can be said here.
//!
//! Time is a model, and what it leaves out is much: caches, bandwidth, conflicts of banks, clocks, and waves that hinder
//! each other but for the vector unit that they share. See [`Chip::share`].

use std::collections::{HashMap, VecDeque};
use std::fmt;

/// Cycles until memory answers a vector load and a scalar one, and until a workgroup's own memory does.
const MEMORY: u64 = 320;
const SCALAR_MEMORY: u64 = 200;
const LOCAL_MEMORY: u64 = 64;
/// Bytes of a workgroup's own memory.
const LOCAL_BYTES: usize = 64 << 10;

/// How a chip runs waves.
#[derive(Clone, Copy, Debug)]
pub struct Chip {
    /// As RADV calls it.
    pub family: &'static str,
    /// Threads of a wave.
    pub wave: usize,
    /// Lanes of one vector unit, and how many of these a compute unit has.
    pub lanes: usize,
    pub units: usize,
    /// Vector registers of a wave's thread that one unit has for all its waves, how many are given out at once, and how
    /// many waves it takes at most.
    pub registers: usize,
    pub granule: usize,
    pub waves: usize,
    /// Cycles from a vector instruction's start to where the next may use its result.
    pub latency: u64,
    /// Whether the workgroup's place and its grid's size come as on GCN.
    pub gcn: bool,
}

impl fmt::Display for Chip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (waves of {})", self.family, self.wave)
    }
}

/// What running a kernel came to.
#[derive(Clone, Copy, Debug)]
pub struct Cost {
    /// Vector instructions of all waves of the workgroup.
    pub vector: u64,
    /// Cycles of the slowest wave with the machine for itself.
    pub alone: u64,
    /// Float results that are too small for a normal number.
    pub denormal: u64,
}

impl Chip {
    /// Workgroups of so many threads and registers that a compute unit runs side by side.
    fn side_by_side(&self, threads: usize, registers: usize) -> usize {
        let waves_a_unit = (self.registers / registers.next_multiple_of(self.granule)).min(self.waves);
        (waves_a_unit * self.units / threads.div_ceil(self.wave)).max(1)
    }

    /// The part of a compute unit's f32 operations, one a lane and cycle, that so many operations of a workgroup are:
    /// what takes longer counts, its vector instructions or its slowest wave, with as many workgroups side by side as fit.
    pub fn share(&self, operations: f64, threads: usize, registers: usize, cost: Cost) -> f64 {
        let lanes = (self.lanes * self.units) as f64;
        let issued = (cost.vector * self.wave as u64) as f64 / lanes;
        let waited = cost.alone as f64 / self.side_by_side(threads, registers) as f64;
        operations / (issued.max(waited) * lanes)
    }

    /// Runs a workgroup of so many threads, the grid's only one, on buffers by their binding.
    pub fn run(&self, assembly: &str, threads: usize, buffers: &mut [Vec<u32>]) -> Cost {
        let program = Program::parse(assembly, self);
        let mut local = vec![0; LOCAL_BYTES / 4];
        let mut waves: Vec<Wave> =
            (0..threads).step_by(self.wave).map(|first| Wave::new(self, first, threads)).collect();
        // From barrier to barrier, one wave after the other.
        while waves.iter().any(|wave| !wave.ended) {
            for wave in waves.iter_mut().filter(|wave| !wave.ended) {
                wave.run(&program, buffers, &mut local);
            }
        }
        Cost {
            vector: waves.iter().map(|wave| wave.vector).sum(),
            alone: waves.iter().map(|wave| wave.clock.now).max().expect("a workgroup has a wave"),
            denormal: waves.iter().map(|wave| wave.denormal).sum(),
        }
    }
}

/// Where an operand is.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Place {
    /// So many vector registers from one on.
    Vector(usize, usize),
    Scalar(usize, usize),
    /// As 32 bits and as 64.
    Constant(u32, u64),
    Condition,
}

/// Scalar registers with a name.
const VCC: usize = 106;
const EXEC: usize = 126;
const NAMED: [(&str, Place); 10] = [
    ("vcc", Place::Scalar(VCC, 2)),
    ("vcc_lo", Place::Scalar(VCC, 1)),
    ("vcc_hi", Place::Scalar(VCC + 1, 1)),
    ("exec", Place::Scalar(EXEC, 2)),
    ("exec_lo", Place::Scalar(EXEC, 1)),
    ("exec_hi", Place::Scalar(EXEC + 1, 1)),
    ("m0", Place::Scalar(124, 1)),
    ("null", Place::Constant(0, 0)),
    ("off", Place::Constant(0, 0)),
    ("src_scc", Place::Condition),
];

/// An operand; a float may be made positive, then turned around.
#[derive(Clone, Copy, Debug)]
struct Operand {
    place: Place,
    negative: bool,
    absolute: bool,
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

    /// The register of a kind that it starts at.
    fn vector(&self) -> usize {
        let Place::Vector(first, _) = self.place else { panic!("{self:?} is no vector register") };
        first
    }

    fn scalar(&self) -> usize {
        let Place::Scalar(first, _) = self.place else { panic!("{self:?} is no scalar register") };
        first
    }
}

/// `7`, `-7`, `0x7f` and `0.5`; a 64-bit operand has the sign's bits, or is a double.
fn constant(text: &str) -> Option<Place> {
    if let Some(hex) = text.strip_prefix("0x") {
        return u32::from_str_radix(hex, 16).ok().map(|bits| Place::Constant(bits, bits.into()));
    }
    if let Ok(whole) = text.parse::<i64>() {
        return Some(Place::Constant(whole as u32, whole as u64));
    }
    let float: f64 = text.contains('.').then(|| text.parse().ok())??;
    Some(Place::Constant((float as f32).to_bits(), float.to_bits()))
}

/// `s7` and `v[4:7]`.
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

/// What an instruction does, and where its operands stand.
#[derive(Clone, Copy)]
enum Action {
    /// To, from up to three, lane by lane; whether it rounds.
    Lanes(fn([u32; 3]) -> u32, bool),
    /// The same that takes what is there as its third.
    Accumulates(fn([u32; 3]) -> u32),
    /// A mask, or on RDNA none, of lanes for which it holds; whether the others are left out from then on.
    Compare(fn(u32, u32) -> bool, bool),
    Select,
    /// To, the carries, two numbers, and the carries before if there are any.
    AddWithCarry,
    /// To two registers, carries, two factors, two registers.
    MultiplyWide,
    ShiftWide,
    Swap,
    FirstLane,
    /// To, from two; by 64 bits if told; what the condition becomes.
    Scalar(fn(u64, u64) -> u64, bool, Condition),
    ScalarCompare(fn(u64, u64) -> bool, bool),
    ScalarSelect(bool),
    /// To what the lanes were; those that are left.
    SaveLanes(fn(u64, u64) -> u64),
    LoadDescriptor,
    LoadScalars,
    Load,
    Store,
    /// So many words; the distance of two addresses' offsets in words, or one address.
    LocalLoad(usize, Option<usize>),
    LocalStore(usize, Option<usize>),
    Branch(fn(&Wave) -> bool),
    Wait(Option<usize>, Option<usize>),
    Barrier,
    Nothing,
    End,
}

/// What a scalar instruction leaves as the condition.
#[derive(Clone, Copy, PartialEq)]
enum Condition {
    Kept,
    NotZero,
    Carry,
    Borrow,
    /// Of a sum of signed numbers, or of a difference.
    Overflow,
    OverflowDown,
}

struct Instruction {
    text: String,
    action: Action,
    operands: Vec<Operand>,
    /// Of memory; and of a workgroup's memory, in elements.
    offset: u32,
    offsets: [u32; 2],
    /// Whether each lane has an address of its own.
    addressed: bool,
    /// Doubles or halves a float at the end.
    scale: Option<f32>,
    /// Where a branch goes.
    target: usize,
    /// Vector instructions that it takes the time of.
    issues: u64,
    is_vector: bool,
    /// The registers that it waits for and those that wait for it, as [`Clock`] numbers them.
    reads: Vec<usize>,
    writes: Vec<usize>,
}

struct Program(Vec<Instruction>);

impl Program {
    fn parse(assembly: &str, chip: &Chip) -> Program {
        let mut labels = HashMap::new();
        let mut instructions: Vec<(Instruction, Option<String>)> = Vec::new();
        for line in assembly.lines() {
            let text = line.split(';').next().unwrap_or_default().trim();
            if text.is_empty() {
                continue;
            }
            if let Some(label) = text.strip_suffix(':') {
                labels.insert(label.to_string(), instructions.len());
            } else if text.starts_with("(then repeated") {
                let times: usize = text.split(' ').find_map(|word| word.parse().ok()).expect("how often");
                let last = line_before(assembly, line);
                instructions.extend((0..times).map(|_| instruction(last, chip)));
            } else {
                instructions.push(instruction(text, chip));
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

fn line_before<'a>(assembly: &'a str, line: &str) -> &'a str {
    let at = line.as_ptr() as usize - assembly.as_ptr() as usize;
    let before = assembly[..at].lines().last().expect("something is repeated");
    before.split(';').next().unwrap_or_default().trim()
}

/// One line; with the label that it names.
fn instruction(text: &str, chip: &Chip) -> (Instruction, Option<String>) {
    let (name, rest) = text.split_once(' ').unwrap_or((text, ""));
    let action = action(name, rest).unwrap_or_else(|| panic!("{}: nobody knows `{text}`", chip.family));
    let mut made = Instruction {
        text: text.to_string(),
        action,
        operands: Vec::new(),
        offset: 0,
        offsets: [0, 0],
        addressed: false,
        scale: None,
        target: 0,
        issues: if name.starts_with("v_mul_lo") || name.starts_with("v_mul_hi") || name.starts_with("v_mad_u64") {
            4
        } else {
            1
        },
        is_vector: name.starts_with("v_"),
        reads: Vec::new(),
        writes: Vec::new(),
    };
    if matches!(action, Action::Wait(..) | Action::Nothing | Action::Barrier | Action::End) {
        return (made, None);
    }
    if matches!(action, Action::Branch(_)) {
        made.reads = match name.rsplit('_').next() {
            Some("scc0" | "scc1") => vec![Clock::CONDITION],
            Some("vccz" | "vccnz") => vec![Clock::SCALAR + VCC, Clock::SCALAR + VCC + 1],
            Some("execz" | "execnz") => vec![Clock::SCALAR + EXEC, Clock::SCALAR + EXEC + 1],
            _ => Vec::new(),
        };
        return (made, Some(rest.trim().to_string()));
    }
    for word in rest.split([',', ' ']).filter(|word| !word.is_empty()) {
        let number = |text: &str| match constant(text) {
            Some(Place::Constant(bits, _)) => bits,
            _ => panic!("{text} of `{}` is no number", made.text),
        };
        match word.split_once(':') {
            Some(("offset", offset)) => made.offset = number(offset),
            Some(("offset0", offset)) => made.offsets[0] = number(offset),
            Some(("offset1", offset)) => made.offsets[1] = number(offset),
            Some(("mul", by)) => made.scale = Some(number(by) as f32),
            Some(("div", by)) => made.scale = Some(1.0 / number(by) as f32),
            None if word == "offen" => made.addressed = true,
            None if ["glc", "slc", "dlc"].contains(&word) => (),
            _ => made.operands.push(Operand::parse(word).unwrap_or_else(|| panic!("{word} of `{text}` is unknown"))),
        }
    }
    // Of 16 bits, with a sign.
    if let ["s", kind, ..] = name.split('_').collect::<Vec<_>>()[..]
        && ["movk", "mulk", "addk", "cmpk"].contains(&kind)
        && !name.ends_with("u32")
        && let Some(Operand { place: Place::Constant(bits, wide), .. }) = made.operands.last_mut()
    {
        (*bits, *wide) = (*bits as i16 as u32, *bits as i16 as u64);
        if ["mulk", "addk"].contains(&kind) {
            made.operands.insert(1, made.operands[0]);
        }
    }
    made.depends();
    (made, None)
}

impl Instruction {
    /// Notes what it reads and writes.
    fn depends(&mut self) {
        use Action::*;
        let of = |operands: &[Operand]| -> Vec<usize> { operands.iter().flat_map(Clock::places).collect() };
        let all = &self.operands[..];
        let written = match self.action {
            Store | LocalStore(..) | ScalarCompare(..) => 0,
            Compare(..) if all.len() == 2 => 0,
            AddWithCarry | MultiplyWide | Swap => 2,
            _ => 1,
        };
        (self.writes, self.reads) = (of(&all[..written]), of(&all[written..]));
        let lanes = [Clock::SCALAR + EXEC, Clock::SCALAR + EXEC + 1];
        match self.action {
            Swap | Accumulates(_) => self.reads.extend(of(&all[..written])),
            Scalar(.., Condition::Kept) => (),
            Scalar(..) | ScalarCompare(..) => self.writes.push(Clock::CONDITION),
            ScalarSelect(_) => self.reads.push(Clock::CONDITION),
            SaveLanes(_) => {
                self.reads.extend(lanes);
                self.writes.extend(lanes);
                self.writes.push(Clock::CONDITION);
            }
            Compare(_, true) => self.writes.extend(lanes),
            _ => (),
        }
        if self.is_vector {
            self.reads.extend(lanes);
        }
    }
}

fn f(bits: u32) -> f32 {
    f32::from_bits(bits)
}

/// What an instruction of this name does.
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
        // Two addresses are told apart in elements, or in 64 of them.
        let apart = if name.contains("st64") || name.contains("stride64") {
            Some(64 * words)
        } else {
            (name.contains('2') && (name.contains("2addr") || name.starts_with("read2") || name.starts_with("write2")))
                .then_some(words)
        };
        return match name.split('_').next()? {
            "load" | "read" | "read2" | "read2st64" => Some(Action::LocalLoad(words, apart)),
            "store" | "write" | "write2" | "write2st64" => Some(Action::LocalStore(words, apart)),
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
        "clause" | "nop" | "inst_prefetch" | "set_inst_prefetch_distance" | "delay_alu" | "code_end" => {
            Some(Action::Nothing)
        }
        "branch" => Some(Action::Branch(|_| true)),
        "cbranch_scc0" => Some(Action::Branch(|wave| !wave.condition)),
        "cbranch_scc1" => Some(Action::Branch(|wave| wave.condition)),
        "cbranch_execz" => Some(Action::Branch(|wave| wave.mask(EXEC) == 0)),
        "cbranch_execnz" => Some(Action::Branch(|wave| wave.mask(EXEC) != 0)),
        "cbranch_vccz" => Some(Action::Branch(|wave| wave.mask(VCC) == 0)),
        "cbranch_vccnz" => Some(Action::Branch(|wave| wave.mask(VCC) != 0)),
        _ if name.starts_with("buffer_load") => words(name).map(|_| Action::LoadScalars),
        _ if name.starts_with("load") => words(name).map(|_| Action::LoadDescriptor),
        _ => scalar_action(name),
    }
}

/// Words that a load or a store takes at one address, by the end of its name.
fn words(name: &str) -> Option<usize> {
    match name.rsplit('_').next()? {
        "dword" | "b32" => Some(1),
        "dwordx2" | "b64" => Some(2),
        "dwordx3" | "b96" => Some(3),
        "dwordx4" | "b128" => Some(4),
        "dwordx8" | "b256" => Some(8),
        "dwordx16" | "b512" => Some(16),
        _ => None,
    }
}

fn vector_action(name: &str) -> Option<Action> {
    use Action::{Accumulates, Compare, Lanes};
    let float = |work| Some(Lanes(work, true));
    let whole = |work| Some(Lanes(work, false));
    if let Some(comparison) = name.strip_prefix("cmp") {
        let (narrows, comparison) = comparison.strip_prefix('x').map_or((false, comparison), |rest| (true, rest));
        let (relation, kind) = comparison.strip_prefix('_')?.split_once('_')?;
        let holds: fn(u32, u32) -> bool = match (kind, relation) {
            ("f32", "lt") => |a, b| f(a) < f(b),
            ("f32", "le") => |a, b| f(a) <= f(b),
            ("f32", "gt") => |a, b| f(a) > f(b),
            ("f32", "ge") => |a, b| f(a) >= f(b),
            ("f32", "eq") => |a, b| f(a) == f(b),
            ("f32", "neq") => |a, b| f(a) != f(b),
            ("i32", "lt") => |a, b| (a as i32) < b as i32,
            ("i32", "le") => |a, b| a as i32 <= b as i32,
            ("i32", "gt") => |a, b| a as i32 > b as i32,
            ("i32", "ge") => |a, b| a as i32 >= b as i32,
            ("u32", "lt") => |a, b| a < b,
            ("u32", "le") => |a, b| a <= b,
            ("u32", "gt") => |a, b| a > b,
            ("u32", "ge") => |a, b| a >= b,
            ("i32" | "u32", "eq") => |a, b| a == b,
            ("i32" | "u32", "ne" | "lg") => |a, b| a != b,
            _ => return None,
        };
        return Some(Compare(holds, narrows));
    }
    match name {
        "mul_f32" => float(|[a, b, _]| (f(a) * f(b)).to_bits()),
        "add_f32" => float(|[a, b, _]| (f(a) + f(b)).to_bits()),
        "sub_f32" => float(|[a, b, _]| (f(a) - f(b)).to_bits()),
        "subrev_f32" => float(|[a, b, _]| (f(b) - f(a)).to_bits()),
        // Product and sum are rounded each.
        "mad_f32" | "madak_f32" | "madmk_f32" => float(|[a, b, c]| (f(a) * f(b) + f(c)).to_bits()),
        "mac_f32" => Some(Accumulates(|[a, b, c]| (f(a) * f(b) + f(c)).to_bits())),
        "fma_f32" | "fmaak_f32" | "fmamk_f32" => float(|[a, b, c]| f(a).mul_add(f(b), f(c)).to_bits()),
        "fmac_f32" => Some(Accumulates(|[a, b, c]| f(a).mul_add(f(b), f(c)).to_bits())),
        "floor_f32" => float(|[a, ..]| f(a).floor().to_bits()),
        "max_f32" => float(|[a, b, _]| f(a).max(f(b)).to_bits()),
        "min_f32" => float(|[a, b, _]| f(a).min(f(b)).to_bits()),
        // Chips are off by a unit in the last place: it is for dividing whole numbers, which makes up for that.
        "rcp_f32" | "rcp_iflag_f32" => float(|[a, ..]| (1.0 / f(a)).to_bits()),
        "cvt_f32_u32" => float(|[a, ..]| (a as f32).to_bits()),
        "cvt_f32_i32" => float(|[a, ..]| (a as i32 as f32).to_bits()),
        // To whole numbers, towards zero and within what they hold, as `as` does.
        "cvt_u32_f32" => whole(|[a, ..]| f(a) as u32),
        "cvt_i32_f32" => whole(|[a, ..]| f(a) as i32 as u32),
        "mov_b32" => whole(|[a, ..]| a),
        "not_b32" => whole(|[a, ..]| !a),
        "and_b32" => whole(|[a, b, _]| a & b),
        "or_b32" => whole(|[a, b, _]| a | b),
        "xor_b32" => whole(|[a, b, _]| a ^ b),
        "or3_b32" => whole(|[a, b, c]| a | b | c),
        "and_or_b32" => whole(|[a, b, c]| a & b | c),
        "add_u32" | "add_nc_u32" => whole(|[a, b, _]| a.wrapping_add(b)),
        "sub_u32" | "sub_nc_u32" => whole(|[a, b, _]| a.wrapping_sub(b)),
        "subrev_u32" | "subrev_nc_u32" => whole(|[a, b, _]| b.wrapping_sub(a)),
        "add3_u32" => whole(|[a, b, c]| a.wrapping_add(b).wrapping_add(c)),
        "add_lshl_u32" => whole(|[a, b, c]| a.wrapping_add(b) << (c & 31)),
        "lshl_add_u32" => whole(|[a, b, c]| (a << (b & 31)).wrapping_add(c)),
        "lshl_or_b32" => whole(|[a, b, c]| a << (b & 31) | c),
        "lshlrev_b32" => whole(|[a, b, _]| b << (a & 31)),
        "lshrrev_b32" => whole(|[a, b, _]| b >> (a & 31)),
        "bfe_u32" => whole(|[a, b, c]| a >> (b & 31) & ((1u32 << (c & 31)) - 1)),
        "bfi_b32" => whole(|[a, b, c]| a & b | !a & c),
        "max_u32" => whole(|[a, b, _]| a.max(b)),
        "min_u32" => whole(|[a, b, _]| a.min(b)),
        "mul_lo_u32" => whole(|[a, b, _]| a.wrapping_mul(b)),
        "mul_hi_u32" => whole(|[a, b, _]| (u64::from(a) * u64::from(b) >> 32) as u32),
        "mul_u32_u24" => whole(|[a, b, _]| (a & 0xff_ffff).wrapping_mul(b & 0xff_ffff)),
        "mad_u32_u24" => whole(|[a, b, c]| (a & 0xff_ffff).wrapping_mul(b & 0xff_ffff).wrapping_add(c)),
        // The place of the lowest bit, or all ones.
        "ffbl_b32" | "ctz_i32_b32" => whole(|[a, ..]| if a == 0 { u32::MAX } else { a.trailing_zeros() }),
        "bcnt_u32_b32" => whole(|[a, b, _]| a.count_ones().wrapping_add(b)),
        "cndmask_b32" => Some(Action::Select),
        "add_co_u32" | "addc_co_u32" | "add_co_ci_u32" => Some(Action::AddWithCarry),
        "mad_u64_u32" => Some(Action::MultiplyWide),
        "lshrrev_b64" => Some(Action::ShiftWide),
        "swap_b32" => Some(Action::Swap),
        "readfirstlane_b32" => Some(Action::FirstLane),
        "nop" => Some(Action::Nothing),
        _ => None,
    }
}

fn scalar_action(name: &str) -> Option<Action> {
    use Condition::{Borrow, Carry, Kept, NotZero, Overflow, OverflowDown};
    let wide = name.ends_with("64");
    let (stem, kind) = name.rsplit_once('_')?;
    if let Some(relation) = stem.strip_prefix("cmp_").or(stem.strip_prefix("cmpk_")) {
        let holds: fn(u64, u64) -> bool = match (kind, relation) {
            ("i32", "lt") => |a, b| (a as i32) < b as i32,
            ("i32", "le") => |a, b| a as i32 <= b as i32,
            ("i32", "gt") => |a, b| a as i32 > b as i32,
            ("i32", "ge") => |a, b| a as i32 >= b as i32,
            ("u32", "lt") => |a, b| a < b,
            ("u32", "le") => |a, b| a <= b,
            ("u32", "gt") => |a, b| a > b,
            ("u32", "ge") => |a, b| a >= b,
            ("i32" | "u32" | "u64", "eq") => |a, b| a == b,
            ("i32" | "u32" | "u64", "lg") => |a, b| a != b,
            _ => return None,
        };
        return Some(Action::ScalarCompare(holds, wide));
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
        ("nand", "b32" | "b64") => scalar(|a, b| !(a & b), NotZero),
        ("nor", "b32" | "b64") => scalar(|a, b| !(a | b), NotZero),
        ("xnor", "b32" | "b64") => scalar(|a, b| !(a ^ b), NotZero),
        ("add", "u32") => scalar(|a, b| a + b, Carry),
        ("sub", "u32") => scalar(|a, b| a.wrapping_sub(b), Borrow),
        ("add", "i32") => scalar(|a, b| a.wrapping_add(b), Overflow),
        ("sub", "i32") => scalar(|a, b| a.wrapping_sub(b), OverflowDown),
        ("addk", "i32") => scalar(|a, b| a.wrapping_add(b), Overflow),
        ("mul" | "mulk", "i32") => scalar(|a, b| a.wrapping_mul(b), Kept),
        ("mul_hi", "u32") => scalar(|a, b| a * b >> 32, Kept),
        ("lshl", "b32") => scalar(|a, b| a << (b & 31), NotZero),
        ("lshr", "b32") => scalar(|a, b| a >> (b & 31), NotZero),
        ("lshl1_add", "u32") => scalar(|a, b| (a << 1) + b, Carry),
        ("lshl2_add", "u32") => scalar(|a, b| (a << 2) + b, Carry),
        ("lshl3_add", "u32") => scalar(|a, b| (a << 3) + b, Carry),
        ("lshl4_add", "u32") => scalar(|a, b| (a << 4) + b, Carry),
        ("min", "u32") => scalar(|a, b| a.min(b), Kept),
        ("max", "u32") => scalar(|a, b| a.max(b), Kept),
        ("cselect", "b32" | "b64") => Some(Action::ScalarSelect(wide)),
        ("and_saveexec", _) => Some(Action::SaveLanes(|lanes, mask| lanes & mask)),
        ("or_saveexec", _) => Some(Action::SaveLanes(|lanes, mask| lanes | mask)),
        ("andn2_saveexec" | "and_not1_saveexec", _) => Some(Action::SaveLanes(|lanes, mask| mask & !lanes)),
        _ => None,
    }
}

/// When what is on its way has come, for one wave that has the machine for itself and goes in order.
struct Clock {
    now: u64,
    /// When each vector register, each scalar one and the condition can be read.
    ready: [u64; Clock::CONDITION + 1],
    /// Answers outstanding, of vector memory and of the others.
    memory: VecDeque<u64>,
    others: VecDeque<u64>,
}

impl Clock {
    const SCALAR: usize = 256;
    const CONDITION: usize = Clock::SCALAR + 128;

    /// An operand's registers.
    fn places(operand: &Operand) -> std::ops::Range<usize> {
        match operand.place {
            Place::Vector(first, count) => first..first + count,
            Place::Scalar(first, count) => Clock::SCALAR + first..Clock::SCALAR + first + count,
            Place::Condition => Clock::CONDITION..Clock::CONDITION + 1,
            Place::Constant(..) => 0..0,
        }
    }

    fn pass(&mut self, chip: &Chip, instruction: &Instruction) {
        use Action::*;
        let start = instruction.reads.iter().map(|&place| self.ready[place]).max().unwrap_or(0).max(self.now);
        let (takes, until) = match instruction.action {
            Nothing | End => return,
            Wait(memory, others) => {
                let mut now = self.now;
                for (queue, left) in [(&mut self.memory, memory), (&mut self.others, others)] {
                    while left.is_some_and(|left| queue.len() > left) {
                        now = now.max(queue.pop_front().expect("longer than that"));
                    }
                }
                self.now = now + 1;
                return;
            }
            Branch(_) => (4, 4),
            _ if instruction.is_vector => {
                let takes = instruction.issues * (chip.wave / chip.lanes) as u64;
                (takes, takes - 1 + chip.latency)
            }
            _ => (1, 2),
        };
        self.now = start + takes;
        for &place in &instruction.writes {
            self.ready[place] = start + until;
        }
        match instruction.action {
            Load => self.memory.push_back(self.now + MEMORY),
            // GCN counts them together.
            Store if chip.gcn => self.memory.push_back(self.now + MEMORY),
            LoadDescriptor | LoadScalars => self.others.push_back(self.now + SCALAR_MEMORY),
            LocalLoad(..) | LocalStore(..) => self.others.push_back(self.now + LOCAL_MEMORY),
            _ => (),
        }
    }
}

struct Wave {
    chip: Chip,
    /// `[registers][lanes]`.
    vector_registers: Vec<[u32; 64]>,
    scalar_registers: [u32; 128],
    condition: bool,
    /// The next instruction.
    at: usize,
    ended: bool,
    /// Vector instructions so far, each as often as it takes the time of one.
    vector: u64,
    denormal: u64,
    clock: Clock,
}

impl Wave {
    /// One that begins with thread `first` of its workgroup.
    fn new(chip: &Chip, first: usize, threads: usize) -> Wave {
        let clock =
            Clock { now: 0, ready: [0; Clock::CONDITION + 1], memory: VecDeque::new(), others: VecDeque::new() };
        let mut wave = Wave {
            chip: *chip,
            vector_registers: vec![[0; 64]; 256],
            scalar_registers: [0; 128],
            condition: false,
            at: 0,
            ended: false,
            vector: 0,
            denormal: 0,
            clock,
        };
        wave.vector_registers[0] = std::array::from_fn(|lane| (first + lane) as u32);
        let alive = chip.wave.min(threads - first);
        wave.set_mask(EXEC, u64::MAX >> (64 - alive));
        // Descriptors lie at 0, and there is one workgroup: its place is 0 along every axis.
        if !chip.gcn {
            wave.scalar_registers[3..6].fill(1);
        }
        wave
    }

    fn mask(&self, first: usize) -> u64 {
        let high = if self.chip.wave == 64 { self.scalar_registers[first + 1] } else { 0 };
        u64::from(high) << 32 | u64::from(self.scalar_registers[first])
    }

    fn set_mask(&mut self, first: usize, mask: u64) {
        self.scalar_registers[first] = mask as u32;
        if self.chip.wave == 64 {
            self.scalar_registers[first + 1] = (mask >> 32) as u32;
        }
    }

    fn lanes(&self) -> impl Iterator<Item = usize> + use<> {
        let lanes = self.mask(EXEC);
        (0..self.chip.wave).filter(move |lane| lanes >> lane & 1 == 1)
    }

    /// 32 bits of an operand for a lane, signs applied.
    fn read(&self, operand: &Operand, lane: usize) -> u32 {
        let bits = match operand.place {
            Place::Vector(first, _) => self.vector_registers[first][lane],
            Place::Scalar(first, _) => self.scalar_registers[first],
            Place::Constant(bits, _) => bits,
            Place::Condition => self.condition.into(),
        };
        let bits = if operand.absolute { bits & 0x7fff_ffff } else { bits };
        if operand.negative { bits ^ 0x8000_0000 } else { bits }
    }

    /// 64 bits of an operand for a lane.
    fn read_wide(&self, operand: &Operand, lane: usize) -> u64 {
        let [low, high] = match operand.place {
            Place::Vector(first, _) => [0, 1].map(|next| self.vector_registers[first + next][lane]),
            Place::Scalar(first, _) => [0, 1].map(|next| self.scalar_registers[first + next]),
            Place::Constant(_, bits) => return bits,
            Place::Condition => [self.condition.into(), 0],
        };
        u64::from(high) << 32 | u64::from(low)
    }

    fn read_scalar(&self, operand: &Operand, wide: bool) -> u64 {
        if wide { self.read_wide(operand, 0) } else { self.read(operand, 0).into() }
    }

    fn write_scalar(&mut self, operand: &Operand, value: u64, wide: bool) {
        let first = operand.scalar();
        self.scalar_registers[first] = value as u32;
        if wide {
            self.scalar_registers[first + 1] = (value >> 32) as u32;
        }
    }

    /// Goes on up to a barrier or the end.
    fn run(&mut self, program: &Program, buffers: &mut [Vec<u32>], local: &mut [u32]) {
        loop {
            let instruction = &program.0[self.at];
            let chip = self.chip;
            self.clock.pass(&chip, instruction);
            self.at += 1;
            if instruction.is_vector {
                self.vector += instruction.issues;
            }
            match instruction.action {
                Action::End => {
                    self.ended = true;
                    return;
                }
                Action::Barrier => return,
                Action::Branch(taken) => {
                    if taken(self) {
                        self.at = instruction.target;
                    }
                }
                Action::Load | Action::Store => self.exchange(instruction, buffers),
                Action::LocalLoad(..) | Action::LocalStore(..) => self.exchange_locally(instruction, local),
                Action::LoadScalars => {
                    let [to, descriptor, offset] = &instruction.operands[..] else { panic!("{}", instruction.text) };
                    let buffer = &buffers[self.scalar_registers[descriptor.scalar()] as usize];
                    let first = self.read(offset, 0).wrapping_add(instruction.offset) as usize / 4;
                    for (word, register) in Clock::places(to).enumerate() {
                        let value = buffer.get(first + word).copied().unwrap_or(0);
                        self.scalar_registers[register - Clock::SCALAR] = value;
                    }
                }
                Action::LoadDescriptor => {
                    let [to, from, offset] = &instruction.operands[..] else { panic!("{}", instruction.text) };
                    let offset = self.read(offset, 0) / 16;
                    // A descriptor, of which there need only be the binding; or the grid's size, one workgroup.
                    let is_descriptor = from.scalar() == 2;
                    for (word, register) in Clock::places(to).enumerate() {
                        let descriptor = if word % 4 == 0 { offset + word as u32 / 4 } else { 0 };
                        self.scalar_registers[register - Clock::SCALAR] = if is_descriptor { descriptor } else { 1 };
                    }
                }
                _ => self.compute(instruction),
            }
        }
    }

    fn compute(&mut self, instruction: &Instruction) {
        let operands = &instruction.operands[..];
        match instruction.action {
            Action::Lanes(work, rounds) => {
                let to = operands[0].vector();
                for lane in self.lanes() {
                    let mut from = [0; 3];
                    for (from, operand) in from.iter_mut().zip(&operands[1..]) {
                        *from = self.read(operand, lane);
                    }
                    let result = self.rounded(work(from), instruction, rounds);
                    self.vector_registers[to][lane] = result;
                }
            }
            Action::Accumulates(work) => {
                let [to, a, b] = operands else { panic!("{}", instruction.text) };
                for lane in self.lanes() {
                    let from = [self.read(a, lane), self.read(b, lane), self.read(to, lane)];
                    let result = self.rounded(work(from), instruction, true);
                    self.vector_registers[to.vector()][lane] = result;
                }
            }
            Action::Compare(holds, narrows) => {
                let (to, a, b) = match operands {
                    [to, a, b] => (Some(to), a, b),
                    [a, b] => (None, a, b),
                    _ => panic!("{}", instruction.text),
                };
                let held = self.lanes().filter(|&lane| holds(self.read(a, lane), self.read(b, lane)));
                let mask = held.fold(0, |mask, lane| mask | 1 << lane);
                if let Some(to) = to {
                    self.set_mask(to.scalar(), mask);
                }
                if narrows {
                    self.set_mask(EXEC, mask);
                }
            }
            Action::Select => {
                let [to, a, b, mask] = operands else { panic!("{}", instruction.text) };
                let mask = self.mask(mask.scalar());
                for lane in self.lanes() {
                    let from = if mask >> lane & 1 == 1 { b } else { a };
                    self.vector_registers[to.vector()][lane] = self.read(from, lane);
                }
            }
            Action::AddWithCarry => {
                let carried = operands.get(4).map_or(0, |mask| self.mask(mask.scalar()));
                let mut carries = 0;
                for lane in self.lanes() {
                    let [a, b] = [2, 3].map(|index| u64::from(self.read(&operands[index], lane)));
                    let sum = a + b + (carried >> lane & 1);
                    carries |= (sum >> 32) << lane;
                    self.vector_registers[operands[0].vector()][lane] = sum as u32;
                }
                self.set_mask(operands[1].scalar(), carries);
            }
            Action::MultiplyWide => {
                let [to, _, a, b, c] = operands else { panic!("{}", instruction.text) };
                for lane in self.lanes() {
                    let product = u64::from(self.read(a, lane)) * u64::from(self.read(b, lane));
                    self.write_wide(to, lane, product.wrapping_add(self.read_wide(c, lane)));
                }
            }
            Action::ShiftWide => {
                let [to, by, from] = operands else { panic!("{}", instruction.text) };
                for lane in self.lanes() {
                    self.write_wide(to, lane, self.read_wide(from, lane) >> (self.read(by, lane) & 63));
                }
            }
            Action::Swap => {
                let [a, b] = [0, 1].map(|index| operands[index].vector());
                for lane in self.lanes() {
                    let [was_a, was_b] = [a, b].map(|register| self.vector_registers[register][lane]);
                    self.vector_registers[a][lane] = was_b;
                    self.vector_registers[b][lane] = was_a;
                }
            }
            Action::FirstLane => {
                let lane = self.lanes().next().unwrap_or(0);
                let value = self.read(&operands[1], lane);
                self.write_scalar(&operands[0], value.into(), false);
            }
            Action::Scalar(work, wide, condition) => {
                let a = self.read_scalar(&operands[1], wide);
                let b = operands.get(2).map_or(0, |operand| self.read_scalar(operand, wide));
                let exact = work(a, b);
                let result = if wide { exact } else { exact & 0xffff_ffff };
                let sign = |bits: u64| bits as u32 >> 31 == 1;
                match condition {
                    Condition::Kept => (),
                    Condition::NotZero => self.condition = result != 0,
                    Condition::Carry => self.condition = exact >> 32 != 0,
                    Condition::Borrow => self.condition = b > a,
                    Condition::Overflow => self.condition = sign(a) == sign(b) && sign(result) != sign(a),
                    Condition::OverflowDown => self.condition = sign(a) != sign(b) && sign(result) != sign(a),
                }
                self.write_scalar(&operands[0], result, wide);
            }
            Action::ScalarCompare(holds, wide) => {
                self.condition = holds(self.read_scalar(&operands[0], wide), self.read_scalar(&operands[1], wide));
            }
            Action::ScalarSelect(wide) => {
                let from = if self.condition { &operands[1] } else { &operands[2] };
                let value = self.read_scalar(from, wide);
                self.write_scalar(&operands[0], value, wide);
            }
            Action::SaveLanes(left) => {
                let wide = self.chip.wave == 64;
                let (lanes, mask) = (self.mask(EXEC), self.read_scalar(&operands[1], wide));
                self.write_scalar(&operands[0], lanes, wide);
                self.set_mask(EXEC, left(lanes, mask));
                self.condition = self.mask(EXEC) != 0;
            }
            _ => (),
        }
    }

    /// A float's result, scaled where it is told, and counted if it is too small.
    fn rounded(&mut self, result: u32, instruction: &Instruction, rounds: bool) -> u32 {
        let scaled = instruction.scale.map_or(result, |scale| (f(result) * scale).to_bits());
        self.denormal += u64::from(rounds && f(scaled).is_subnormal());
        scaled
    }

    fn write_wide(&mut self, to: &Operand, lane: usize, value: u64) {
        for (next, half) in [value as u32, (value >> 32) as u32].into_iter().enumerate() {
            self.vector_registers[to.vector() + next][lane] = half;
        }
    }

    /// Loads from a buffer, or stores; nothing is outside of it.
    fn exchange(&mut self, instruction: &Instruction, buffers: &mut [Vec<u32>]) {
        let [data, address, descriptor, offset] = &instruction.operands[..] else { panic!("{}", instruction.text) };
        let Place::Vector(first, count) = data.place else { panic!("{}", instruction.text) };
        let buffer = &mut buffers[self.scalar_registers[descriptor.scalar()] as usize];
        let base = self.read(offset, 0).wrapping_add(instruction.offset);
        for lane in self.lanes() {
            let own = if instruction.addressed { self.read(address, lane) } else { 0 };
            let at = own.wrapping_add(base) as usize / 4;
            for next in 0..count {
                let register = &mut self.vector_registers[first + next][lane];
                match (instruction.action, buffer.get_mut(at + next)) {
                    (Action::Load, word) => *register = word.copied().unwrap_or(0),
                    (_, Some(word)) => *word = *register,
                    (_, None) => (),
                }
            }
        }
    }

    /// The same with the workgroup's memory, at one address or two.
    fn exchange_locally(&mut self, instruction: &Instruction, local: &mut [u32]) {
        let (loads, words, apart) = match instruction.action {
            Action::LocalLoad(words, apart) => (true, words, apart),
            Action::LocalStore(words, apart) => (false, words, apart),
            _ => unreachable!("{}", instruction.text),
        };
        let (address, data) = match (&instruction.operands[..], loads) {
            ([data, address], true) => (address, [data.vector(), data.vector() + words]),
            ([address, data], false) => (address, [data.vector(); 2]),
            ([address, a, b], false) => (address, [a.vector(), b.vector()]),
            _ => panic!("{}", instruction.text),
        };
        let offsets = match apart {
            Some(apart) => instruction.offsets.map(|offset| offset * apart as u32 * 4).to_vec(),
            None => vec![instruction.offset],
        };
        for lane in self.lanes() {
            let own = self.read(address, lane);
            for (&offset, &first) in offsets.iter().zip(&data) {
                let at = own.wrapping_add(offset) as usize / 4;
                for next in 0..words {
                    let register = &mut self.vector_registers[first + next][lane];
                    match (loads, local.get_mut(at + next)) {
                        (true, word) => *register = word.copied().unwrap_or(0),
                        (false, Some(word)) => *word = *register,
                        (false, None) => (),
                    }
                }
            }
        }
    }
}
