//! Emulates a workgroup that runs RADV's machine code, and estimates its time.
//!
//! The emulator follows AMD's instruction sets of Vega, RDNA 2 and RDNA 3. That it is correct shows in its results,
//! which equal the CPU's. Floats round to nearest. Results that the chip may flush to zero are counted, because the
//! emulator does not flush them.
//!
//! The time is a model. It leaves out caches, bandwidth, bank conflicts and clock rates. Waves compete only for the
//! vector unit. See [`Chip::share`].

use std::collections::VecDeque;
use std::fmt;

use crate::assembly::{Action, CONDITION, Change, EXEC, Instruction, Operand, Place, Program, SCALAR, When, f};

/// Latency in cycles of vector loads, scalar loads, and accesses to a workgroup's memory.
const MEMORY: u64 = 320;
const SCALAR_MEMORY: u64 = 200;
const LOCAL_MEMORY: u64 = 64;
/// Bytes of a workgroup's memory.
const LOCAL_BYTES: usize = 64 << 10;
/// The initial content of registers and memory. As a float, it is NaN.
pub const GARBAGE: u32 = 0xffff_dead;

/// The properties of a chip.
#[derive(Clone, Copy, Debug)]
pub struct Chip {
    /// RADV's name of the family.
    pub family: &'static str,
    /// Threads per wave.
    pub wave: usize,
    /// Lanes per vector unit, and vector units per compute unit.
    pub lanes: usize,
    pub units: usize,
    /// Vector registers per lane of a vector unit, shared by its waves; the granule in which they are allocated; and
    /// the maximum number of waves.
    pub registers: usize,
    pub granule: usize,
    pub waves: usize,
    /// Cycles from the start of a vector instruction until another can use its result.
    pub latency: u64,
    /// Whether it is a GCN chip. These have unfused multiply-adds, and pass the size of the grid in another way.
    pub gcn: bool,
}

impl fmt::Display for Chip {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} (waves of {})", self.family, self.wave)
    }
}

/// The result of running a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Cost {
    /// Number of vector instructions, in all waves of the workgroup.
    pub vector: u64,
    /// Cycles of the slowest wave, if each has the machine for itself.
    pub slowest_wave: u64,
    /// Number of float results that are denormal.
    pub denormal: u64,
}

impl Chip {
    /// Returns how many workgroups a compute unit runs at the same time.
    fn concurrent_workgroups(&self, threads: usize, registers: usize) -> usize {
        let waves_per_unit = (self.registers / registers.next_multiple_of(self.granule)).min(self.waves);
        (waves_per_unit * self.units / threads.div_ceil(self.wave)).max(1)
    }

    /// Returns the operations of a workgroup as a share of a compute unit's f32 rate, which is one per lane and cycle.
    /// The time of a workgroup is the larger of two times: that of its vector instructions, and that of its slowest
    /// wave divided by the number of concurrent workgroups.
    pub fn share(&self, operations: f64, threads: usize, registers: usize, cost: Cost) -> f64 {
        let lanes = (self.lanes * self.units) as f64;
        let issued = (cost.vector * self.wave as u64) as f64 / lanes;
        let waited = cost.slowest_wave as f64 / self.concurrent_workgroups(threads, registers) as f64;
        operations / (issued.max(waited) * lanes)
    }

    /// Runs a grid of one workgroup. `buffers` has the buffer of each binding.
    pub fn run(&self, assembly: &str, threads: usize, buffers: &mut [Vec<u32>]) -> Cost {
        let program = Program::parse(assembly, self.family);
        let mut local = vec![GARBAGE; LOCAL_BYTES / 4];
        let mut waves: Vec<Wave> =
            (0..threads).step_by(self.wave).map(|first| Wave::new(self, first, threads)).collect();
        // Waves run one after the other, each up to the next barrier.
        while waves.iter().any(|wave| !wave.ended) {
            for wave in waves.iter_mut().filter(|wave| !wave.ended) {
                wave.run(&program, buffers, &mut local);
            }
        }
        Cost {
            vector: waves.iter().map(|wave| wave.vector).sum(),
            slowest_wave: waves.iter().map(|wave| wave.clock.now).max().expect("a workgroup has a wave"),
            denormal: waves.iter().map(|wave| wave.denormal).sum(),
        }
    }
}

/// The time of one in-order wave that has the machine for itself.
struct Clock {
    now: u64,
    /// The time from which each register can be read.
    ready: [u64; CONDITION + 1],
    /// Completion times of outstanding accesses: to memory by vector instructions, and all others.
    memory: VecDeque<u64>,
    others: VecDeque<u64>,
}

impl Clock {
    /// Advances by one instruction.
    fn advance(&mut self, chip: &Chip, instruction: &Instruction) {
        use Action::*;
        let start = instruction.reads.iter().map(|&place| self.ready[place]).max().unwrap_or(0).max(self.now);
        let (takes, until) = match instruction.action {
            Nothing | End => return,
            Wait(memory, others) => {
                let mut now = self.now;
                for (queue, left) in [(&mut self.memory, memory), (&mut self.others, others)] {
                    while left.is_some_and(|left| queue.len() > left) {
                        now = now.max(queue.pop_front().expect("the queue is not empty"));
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
            // GCN counts loads and stores together.
            Store if chip.gcn => self.memory.push_back(self.now + MEMORY),
            LoadDescriptor | LoadScalars => self.others.push_back(self.now + SCALAR_MEMORY),
            LocalLoad(..) | LocalStore(_) => self.others.push_back(self.now + LOCAL_MEMORY),
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
    /// The index of the next instruction.
    at: usize,
    ended: bool,
    /// Number of vector instructions, weighted with [`Instruction::issues`].
    vector: u64,
    denormal: u64,
    clock: Clock,
}

impl Wave {
    /// Makes a wave that starts with thread `first` of its workgroup.
    fn new(chip: &Chip, first: usize, threads: usize) -> Wave {
        let clock = Clock { now: 0, ready: [0; CONDITION + 1], memory: VecDeque::new(), others: VecDeque::new() };
        let mut wave = Wave {
            chip: *chip,
            vector_registers: vec![[GARBAGE; 64]; 256],
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
        // Descriptors are at address 0. The position of the only workgroup is 0 on every axis.
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

    /// Returns 32 bits of an operand for a lane, with its modifiers applied.
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

    /// Returns 64 bits of an operand for a lane.
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

    /// Runs up to the next barrier or the end.
    fn run(&mut self, program: &Program, buffers: &mut [Vec<u32>], local: &mut [u32]) {
        loop {
            let instruction = &program.0[self.at];
            let chip = self.chip;
            self.clock.advance(&chip, instruction);
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
                Action::Branch(when) => {
                    let taken = match when {
                        When::Always => true,
                        When::Condition(held) => self.condition == held,
                        When::Empty => self.mask(EXEC) == 0,
                    };
                    if taken {
                        self.at = instruction.target;
                    }
                }
                Action::Load | Action::Store => self.exchange(instruction, buffers),
                Action::LocalLoad(..) | Action::LocalStore(_) => self.exchange_locally(instruction, local),
                Action::LoadScalars => {
                    let [to, descriptor, offset] = &instruction.operands[..] else { panic!("{}", instruction.text) };
                    let buffer = &buffers[self.scalar_registers[descriptor.scalar()] as usize];
                    let first = self.read(offset, 0).wrapping_add(instruction.offset) as usize / 4;
                    for (word, register) in to.registers().enumerate() {
                        let value = buffer.get(first + word).copied().unwrap_or(0);
                        self.scalar_registers[register - SCALAR] = value;
                    }
                }
                Action::LoadDescriptor => {
                    let [to, from, offset] = &instruction.operands[..] else { panic!("{}", instruction.text) };
                    let offset = self.read(offset, 0) / 16;
                    // This loads a descriptor, for which the emulator uses the binding, or the grid's size, 1.
                    let is_descriptor = from.scalar() == 2;
                    for (word, register) in to.registers().enumerate() {
                        let descriptor = if word % 4 == 0 { offset + word as u32 / 4 } else { 0 };
                        self.scalar_registers[register - SCALAR] = if is_descriptor { descriptor } else { 1 };
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
                let carried = self.mask(operands[4].scalar());
                let mut carries = 0;
                for lane in self.lanes() {
                    let [a, b] = [2, 3].map(|index| u64::from(self.read(&operands[index], lane)));
                    let sum = a + b + (carried >> lane & 1);
                    carries |= (sum >> 32) << lane;
                    self.vector_registers[operands[0].vector()][lane] = sum as u32;
                }
                self.set_mask(operands[1].scalar(), carries);
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
            Action::ReadLane => {
                let lane = self.read_scalar(&operands[2], false) as usize;
                let value = self.vector_registers[operands[1].vector()][lane];
                self.write_scalar(&operands[0], value.into(), false);
            }
            Action::WriteLane => {
                let lane = self.read_scalar(&operands[2], false) as usize;
                self.vector_registers[operands[0].vector()][lane] = self.read_scalar(&operands[1], false) as u32;
            }
            Action::Scalar(work, wide, condition) => {
                let a = self.read_scalar(&operands[1], wide);
                let b = operands.get(2).map_or(0, |operand| self.read_scalar(operand, wide));
                let exact = work(a, b);
                let result = if wide { exact } else { exact & 0xffff_ffff };
                let sign = |bits: u64| bits as u32 >> 31 == 1;
                match condition {
                    Change::Kept => (),
                    Change::NotZero => self.condition = result != 0,
                    Change::Carry => self.condition = exact >> 32 != 0,
                    Change::Overflow => self.condition = sign(a) == sign(b) && sign(result) != sign(a),
                    Change::OverflowDown => self.condition = sign(a) != sign(b) && sign(result) != sign(a),
                }
                self.write_scalar(&operands[0], result, wide);
            }
            Action::ScalarCompare(holds) => {
                self.condition = holds(self.read(&operands[0], 0), self.read(&operands[1], 0));
            }
            Action::ScalarSelect(wide) => {
                let from = if self.condition { &operands[1] } else { &operands[2] };
                let value = self.read_scalar(from, wide);
                self.write_scalar(&operands[0], value, wide);
            }
            Action::SaveLanes => {
                let wide = self.chip.wave == 64;
                let (lanes, mask) = (self.mask(EXEC), self.read_scalar(&operands[1], wide));
                self.write_scalar(&operands[0], lanes, wide);
                self.set_mask(EXEC, lanes & mask);
                self.condition = self.mask(EXEC) != 0;
            }
            _ => (),
        }
    }

    /// Returns a result, scaled if the instruction says so. Counts it if it is denormal.
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

    /// Loads from a buffer or stores to it. Loads out of bounds give 0, and stores out of bounds do nothing.
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

    /// Loads from the workgroup's memory or stores to it, at one or two addresses.
    fn exchange_locally(&mut self, instruction: &Instruction, local: &mut [u32]) {
        let [a, b] = &instruction.operands[..] else { panic!("{}", instruction.text) };
        let (loads, words, unit, data, address) = match instruction.action {
            Action::LocalLoad(words, unit) => (true, words, unit, a.vector(), b),
            Action::LocalStore(words) => (false, words, None, b.vector(), a),
            _ => unreachable!("{}", instruction.text),
        };
        let offsets = match unit {
            Some(unit) => instruction.offsets.map(|offset| offset * unit as u32 * 4).to_vec(),
            None => vec![instruction.offset],
        };
        for lane in self.lanes() {
            let own = self.read(address, lane);
            for (&offset, first) in offsets.iter().zip([data, data + words]) {
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
