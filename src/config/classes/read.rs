//! Reads classes of agents and groups of POIs, `[[agents]]` and `[[pois]]`.

use std::collections::{HashMap, HashSet};
use std::f64::consts::FRAC_PI_2;

use serde::Serialize;

use crate::config::{
    AGENTS, AgentClass, Channel, Choice, Combine, Control, Frame, MAX_AGENTS, MAX_CHANNELS, MAX_CLASSES,
    MAX_HIDDEN_UNITS, MAX_INPUTS, MAX_LEARNERS, MAX_POIS, MAX_SECTORS, MAX_TERMS, Measure, Mobility, Motion, POIS,
    PoiGroup, Region, Score, Sectors, Term, When,
};
use crate::model::classes::DRAWN;
use crate::model::rule::{WINDOWS, cycle, windows};
use crate::model::sense::MOST_MEASURED;
use crate::model::{LEAST, LONGEST, MAX_RANGES};
use crate::reader::{Allowed, KeyRequest, Number, Reader, Value, between, sized};

/// Maximum length of a name.
const LONGEST_NAME: usize = 64;

/// The names and numbers that tables can refer to, before any table is checked.
#[derive(Default)]
pub(in crate::config) struct Summary {
    /// The classes of agents.
    pub classes: Vec<ClassSummary>,
    /// The groups of POIs.
    pub groups: Vec<GroupSummary>,
    /// Groups of which each comes after the next, and the last after the first. Empty if there are none.
    cycle: Vec<usize>,
}

/// A class of agents before it is checked.
pub(in crate::config) struct ClassSummary {
    pub name: String,
    /// `None` if it is wrong.
    pub control: Option<Control>,
    /// The number of its agents.
    pub agents: usize,
    pub observes: bool,
    /// Whether it has a rule, whose radius is the default of influence radii.
    pub has_rule: bool,
}

impl ClassSummary {
    fn learns(&self) -> bool {
        self.control.as_ref().is_some_and(Control::learns)
    }
}

/// A group of POIs before it is checked.
pub(in crate::config) struct GroupSummary {
    pub name: String,
    /// The number of its POIs.
    pub pois: usize,
    pub value: f64,
}

impl Summary {
    /// Looks at the lists of a config.
    pub fn peek(r: &Reader<'_>) -> Summary {
        let word = |value: Option<&Value<'_>>| value.and_then(Value::word).unwrap_or_default().to_string();
        let count = |value: Option<&Value<'_>>| value.and_then(Value::list).map_or(0, <[_]>::len);
        let size = |table: &Value<'_>| {
            let given = table.key("count").and_then(usize::read).flatten().unwrap_or(0);
            count(table.key("at")).max(given.min(MAX_AGENTS))
        };
        let class = |table: &Value<'_>| {
            let control = table.key("control").map_or(Some("policy"), Value::word);
            let control = control.and_then(Control::of);
            ClassSummary {
                name: word(table.key("name")),
                has_rule: control == Some(Control::Follow) || count(table.key("rule")) > 0,
                control,
                agents: size(table),
                observes: table.key("observes").and_then(|value| value.flag()).unwrap_or(true),
            }
        };
        let group = |table: &Value<'_>| GroupSummary {
            name: word(table.key("name")),
            pois: size(table),
            value: table.key("value").and_then(f64::read).flatten().unwrap_or(1.0),
        };
        let tables = r.peek(POIS);
        let groups: Vec<GroupSummary> = tables.iter().map(group).collect();
        let index: HashMap<&str, usize> =
            groups.iter().enumerate().map(|(index, group)| (&*group.name, index)).collect();
        let after = |table: &Value<'_>| {
            let after = table.key("after").map(|after| after.list().unwrap_or(std::slice::from_ref(after)));
            let names = after.unwrap_or_default().iter().filter_map(Value::word);
            names.filter_map(|name| index.get(name).copied()).collect()
        };
        let after: Vec<Vec<usize>> = tables.iter().take(MAX_POIS).map(after).collect();
        let is_short = |groups: &Vec<usize>| groups.iter().all(|&group| group < after.len());
        let cycle = if after.iter().all(is_short) { cycle(&after).unwrap_or_default() } else { vec![] };
        let mut classes: Vec<ClassSummary> = r.peek(AGENTS).iter().map(class).collect();
        let names: HashSet<String> = classes.iter().map(|class| class.name.clone()).collect();
        let is_wrong = |control: &Control| control.target().is_some_and(|target| !names.contains(target));
        for class in &mut classes {
            class.control.take_if(|control| is_wrong(control));
        }
        Summary { classes, groups, cycle }
    }

    /// Returns the number of agents that observe POIs whose group does not name its observers.
    pub fn observers(&self) -> usize {
        self.classes.iter().filter(|class| class.observes).map(|class| class.agents).sum()
    }

    /// Returns the number of agents that learn.
    pub fn learners(&self) -> usize {
        self.classes.iter().filter(|class| class.learns()).map(|class| class.agents).sum()
    }

    /// Returns the agents of a class of this name, if there is one.
    fn size_of(&self, name: &str) -> Option<usize> {
        self.classes.iter().find(|class| class.name == name).map(|class| class.agents)
    }

    /// Returns the number of agents or POIs that a channel names.
    fn named_by(&self, of: &[String], pois: &[String]) -> usize {
        let all = |name: &str| of.iter().any(|of| of == name);
        let classes = self.classes.iter().filter(|class| all(AGENTS) || all(&class.name)).map(|class| class.agents);
        if all(POIS) { self.groups_of(pois).map(|group| group.pois).sum() } else { classes.sum() }
    }

    /// Returns the groups of these names, or all without names.
    fn groups_of(&self, names: &[String]) -> impl Iterator<Item = &GroupSummary> {
        self.groups.iter().filter(|group| names.is_empty() || names.contains(&group.name))
    }

    /// Returns the names of classes, and some further ones. Returns `None` if the list or a name is wrong, which is
    /// reported.
    fn class_names<'n>(&'n self, others: &[&'n str]) -> Option<Vec<&'n str>> {
        let names = valid_names(self.classes.iter().map(|class| &*class.name), MAX_CLASSES)?;
        Some(others.iter().copied().chain(names).collect())
    }

    /// Returns the names of groups, or `None` if one is wrong.
    fn group_names(&self) -> Option<Vec<&str>> {
        valid_names(self.groups.iter().map(|group| &*group.name), MAX_POIS)
    }
}

/// Reads the classes of agents on a map with these sides.
pub(in crate::config) fn read_agents(
    r: &mut Reader<'_>,
    sides: [Allowed<f64>; 2],
    summary: &Summary,
) -> Vec<AgentClass> {
    let classes = r.tables(AGENTS, 1..=MAX_CLASSES, |r, index| AgentClass::read(r, index, sides, summary));
    let does_not_learn = |class: &ClassSummary| class.control.is_some() && !class.learns();
    if !classes.is_empty() && summary.classes.iter().all(does_not_learn) {
        r.report_key(AGENTS, "found no class that learns, allowed one or more with control = \"policy\"".into());
    }
    classes
}

/// Reads the groups of POIs on a map with these sides, for episodes of so many steps.
pub(in crate::config) fn read_pois(
    r: &mut Reader<'_>,
    sides: [Allowed<f64>; 2],
    steps: usize,
    summary: &Summary,
) -> Vec<PoiGroup> {
    r.tables(POIS, 1..=MAX_POIS, |r, index| PoiGroup::read(r, index, sides, steps, summary))
}

/// The form of a name, for errors.
const NAME: &str = "a name of letters, digits, _ and -";

/// Returns what is wrong with the name of a table, if anything. `before` are the names of the tables before it.
fn name_problem(name: &str, mut before: impl Iterator<Item = impl AsRef<str>>) -> Option<String> {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'-';
    match name {
        _ if name.is_empty() || !name.bytes().all(is_plain) => Some(format!("found {name:?}, allowed {NAME}")),
        _ if name.len() > LONGEST_NAME => Some(format!("found {} characters, allowed 1 to {LONGEST_NAME}", name.len())),
        AGENTS | POIS => Some(format!("found {name:?}, which names all of them, allowed another name")),
        _ if before.any(|other| other.as_ref() == name) => Some(format!("found {name:?} again, allowed another name")),
        _ => None,
    }
}

/// Returns these names, or `None` if there are more than `most` or one is wrong.
fn valid_names<'n>(names: impl ExactSizeIterator<Item = &'n str>, most: usize) -> Option<Vec<&'n str>> {
    let mut seen = HashSet::new();
    let mut is_valid = |name: &'n str| name_problem(name, std::iter::empty::<&str>()).is_none() && seen.insert(name);
    if names.len() > most { None } else { names.map(|name| is_valid(name).then_some(name)).collect() }
}

/// Reports positions that exceed the limit together with those of the tables before.
fn limit(r: &mut Reader<'_>, key: &'static str, what: &str, [before, own, most]: [usize; 3]) {
    if own <= most && before <= most && before + own > most {
        let all = before + own;
        r.report_key(key, format!("found {own}, which makes {all} {what} with those before, allowed 1 to {most}"));
    }
}

/// How errors name the controls of classes that learn.
const LEARNS: &str = "\"policy\" or \"choose:CLASS\"";

/// Reads what decides how the agents of a class move.
fn control(r: &mut Reader<'_>, summary: &Summary) -> Control {
    const RANGE: &str = "\"policy\" or \"follow\" or \"nearest:CLASS\" or \"choose:CLASS\" or \"still\"";
    /// Without the output for nobody.
    const MOST: usize = MAX_HIDDEN_UNITS - 1;
    let parse = |word: &str| {
        let control = Control::of(word).ok_or(RANGE)?;
        let names = || summary.class_names(&[]).unwrap_or_default().into_iter();
        match control.target().map(|target| summary.size_of(target)) {
            Some(None) => {
                let kind = control.kind();
                Err(names().map(|name| format!("\"{kind}:{name}\"")).collect::<Vec<_>>().join(" or "))
            }
            Some(Some(size)) if control.learns() && size > MOST => {
                Err(format!("a class of 1 to {MOST} agents, and this has {size}"))
            }
            _ => Ok(control),
        }
    };
    AgentClass::control(r).optional_word(RANGE, "\"policy\"", parse).unwrap_or(Control::Policy)
}

/// Reads the box in which agents stay that start at these places or in this region.
fn stays_in(
    r: &mut Reader<'_>,
    [width, height]: [Allowed<f64>; 2],
    at: &[[f64; 2]],
    region: Option<Region>,
) -> Option<[f64; 4]> {
    let errors = r.error_count();
    let found = AgentClass::stays_in(r).optional_tuple("x0, y0, x1, y1", [width, height, width, height]);
    let [x0, y0, x1, y1] = found.filter(|_| r.error_count() == errors)?;
    if x0 > x1 || y0 > y1 {
        let message = format!("found [{x0}, {y0}, {x1}, {y1}], allowed x0 <= x1 and y0 <= y1");
        r.report_key("agents.stays_in", message);
        return None;
    }
    let corners = region.map(Region::corners).unwrap_or_default();
    let places = if region.is_some() { &corners[..] } else { at };
    let is_outside = |[x, y]: &&[f64; 2]| !((x0..=x1).contains(x) && (y0..=y1).contains(y));
    if let Some([x, y]) = places.iter().find(is_outside) {
        let message = format!("found a start at ({x}, {y}), allowed within stays_in, ({x0}, {y0}) to ({x1}, {y1})");
        r.report_key(if region.is_some() { "agents.in" } else { "agents.at" }, message);
    }
    found
}

/// A key of a table.
type Key = for<'r, 'a> fn(&'r mut Reader<'a>) -> KeyRequest<'r, 'a>;

/// Reads where the agents of a class or the POIs of a group are: at given positions, or a number of them in a region.
/// `names` are the keys' full names, and `before` is the number of agents or POIs in the tables before.
fn places(
    r: &mut Reader<'_>,
    [at, count, region]: [Key; 3],
    names: [&'static str; 3],
    sides: [Allowed<f64>; 2],
    (what, before, most): (&str, usize, usize),
) -> (Vec<[f64; 2]>, Option<usize>, Option<Region>) {
    let listed = most.min(MAX_LEARNERS);
    let at = at(r).positions(1..=listed, sides, Some(vec![])).unwrap_or_default();
    let errors = r.error_count();
    let count = count(r).optional_number(between(1, most), "none").filter(|_| r.error_count() == errors);
    let region = region(r).optional_table("in", "one of the keys below", |r| Region::read(r, sides)).flatten();
    let [at_name, count_name, region_name] = names;
    match names.map(|name| r.has(name)) {
        [true, _, true] => r.report_key(region_name, "found with `at`, allowed either of them".into()),
        [true, true, false] => r.report_key(count_name, "found with `at`, allowed with `in`".into()),
        [false, true, false] => {
            r.report_key(region_name, "missing, allowed a table with one of box, disc and circle".into());
        }
        [false, false, true] => r.report_key(count_name, format!("missing, allowed 1 to {most}, the number of {what}")),
        [false, false, false] => {
            let message = format!("missing, allowed a list of 1 to {listed} positions [x, y], or `count` with `in`");
            r.report_key(at_name, message);
        }
        [true, false, false] | [false, true, true] => {}
    }
    let (key, own) = if at.is_empty() { (count_name, count.unwrap_or(0)) } else { (at_name, at.len()) };
    limit(r, key, what, [before, own, most]);
    (at, count, region)
}

impl AgentClass {
    fn read(r: &mut Reader<'_>, index: usize, sides: [Allowed<f64>; 2], summary: &Summary) -> AgentClass {
        let before = summary.classes.get(..index).unwrap_or_default();
        let name = AgentClass::name(r).name(NAME, |name| name_problem(name, before.iter().map(|class| &class.name)));
        let limits = ("agents", before.iter().map(|class| class.agents).sum(), MAX_AGENTS);
        let keys: [Key; 3] = [AgentClass::at, AgentClass::count, AgentClass::region];
        let (at, count, region) = places(r, keys, ["agents.at", "agents.count", "agents.in"], sides, limits);
        let size = count.unwrap_or(at.len());
        let counts = if size == 0 { 0..=usize::MAX } else { size..=size };
        let heading = AgentClass::heading(r).one_or_each_or(between(-1e3, 1e3), counts, DRAWN, FRAC_PI_2);
        let control = control(r, summary);
        let learns = control.learns();
        let found_with = |allowed: &str| format!("found with control = \"{control}\", allowed with {allowed}");
        // If the control is wrong, what it needs is unknown.
        let is_known = summary.classes.get(index).is_none_or(|class| class.control.is_some());
        let other = before.iter().find(|class| class.control.is_some() && !class.learns());
        if let (true, Some(other)) = (learns && is_known, other) {
            let message = format!(
                "found a class that learns after {:?}, which does not; allowed before all classes that do not learn",
                other.name
            );
            r.report_key("agents.control", message);
        }
        let (motion, speeds) = AgentClass::motion(r)
            .table("motion", "the keys below", "kind = \"steered\", with its defaults", Mobility::read)
            .unwrap_or_else(|| (Mobility::Free { max_speed: 1e3 }, between(0.0, 1e3)));
        let reach = AgentClass::reach(r)
            .optional_number(between(0.01, LONGEST).or_unlimited(), "inf")
            .filter(|reach| reach.is_finite());
        if r.has("agents.reach") && is_known && !matches!(control, Control::Nearest(_)) {
            r.report_key("agents.reach", found_with("\"nearest:CLASS\""));
        }
        let stays_in = stays_in(r, sides, &at, region);
        let speed = AgentClass::speed(r).number(speeds, 0.0);
        let is_free = matches!(motion, Mobility::Free { .. });
        let channel = |r: &mut Reader<'_>, _| Channel::read(r, is_free, summary);
        let errors = r.error_count();
        let senses = AgentClass::senses(r).tables(0..=MAX_CHANNELS, "channels", channel);
        let inputs: usize = senses.iter().map(|channel| channel.sectors.count()).sum();
        if !is_known || r.error_count() > errors {
            // A channel that is wrong is there.
        } else if learns && senses.is_empty() {
            r.report_key("agents.senses", format!("missing, allowed a list of 1 to {MAX_CHANNELS} channels"));
        } else if !learns && !senses.is_empty() {
            r.report_key("agents.senses", found_with(LEARNS));
        } else if inputs > MAX_INPUTS {
            r.report_key(
                "agents.senses",
                format!("found {inputs} sectors, allowed up to {MAX_INPUTS} in all channels"),
            );
        }
        let parse = |name: &str| match senses.iter().any(|channel| channel.senses(name) && channel.range > 0.0) {
            true if summary.size_of(name).is_some() => Ok(name.to_string()),
            _ => Err("a class that it senses".to_string()),
        };
        let moves_near = AgentClass::moves_near(r).optional_word("the name of a class that it senses", "none", parse);
        let errors = r.error_count();
        let rule = AgentClass::rule(r).tables(0..=MAX_TERMS, "terms", |r, _| Term::read(r, summary));
        if !is_known || r.error_count() > errors {
            // A term that is wrong is there.
        } else if control == Control::Follow && rule.is_empty() {
            r.report_key("agents.rule", format!("missing, allowed a list of 1 to {MAX_TERMS} terms"));
        } else if control != Control::Follow && !rule.is_empty() {
            r.report_key("agents.rule", found_with("\"follow\""));
        }
        let errors = r.error_count();
        let names = summary.class_names(&[]);
        let leads = AgentClass::leads(r).names("names of classes", false, names.as_deref(), |_| None);
        if !leads.is_empty() && is_known && !learns {
            r.report_key("agents.leads", found_with(LEARNS) + ": others cannot lead yet");
        }
        let influence_radius = AgentClass::influence_radius(r)
            .optional_number(between(0.01, LONGEST), "the largest radius of the led class's rule");
        let ruleless =
            |class: &&ClassSummary| leads.contains(&class.name) && class.control.is_some() && !class.has_rule;
        if r.error_count() > errors {
            // Leads or radius are wrong.
        } else if influence_radius.is_some() && leads.is_empty() {
            r.report_key("agents.influence_radius", "found without `leads`, which it is the radius of".into());
        } else if let (None, Some(led)) = (influence_radius, summary.classes.iter().find(ruleless)) {
            let message = format!("missing, and {:?} has no rule to take it from; allowed 0.01 to {LONGEST}", led.name);
            r.report_key("agents.influence_radius", message);
        }
        let fitness = AgentClass::fitness(r).optional_choice("learning.fitness");
        if fitness.is_some() && is_known && !learns {
            r.report_key("agents.fitness", found_with(LEARNS));
        }
        AgentClass {
            name,
            at,
            count,
            region,
            heading,
            speed,
            control,
            reach,
            motion,
            stays_in,
            moves_near,
            senses,
            rule,
            wall_radius: AgentClass::wall_radius(r).number(between(0.01, LONGEST).or_zero(), 1.0),
            wall_gain: AgentClass::wall_gain(r).number(between(1e-3, 1e3).or_zero(), 1.0),
            leads,
            influence_radius,
            observes: AgentClass::observes(r).flag(true),
            fitness,
        }
    }
}

/// The value of `motion.kind`.
#[derive(Clone, Copy, Serialize)]
#[serde(rename_all = "lowercase")]
enum Kind {
    Steered,
    Free,
}

impl Choice for Kind {
    const ALL: &'static [(&'static str, Kind)] = &[("steered", Kind::Steered), ("free", Kind::Free)];
}

impl Mobility {
    /// Reads the table, and returns the range of start speeds too.
    fn read(r: &mut Reader<'_>) -> (Mobility, Allowed<f64>) {
        let meaning = "steered: it has a heading and a speed, and turns and accelerates within the limits below; free: its \
                       actions are its velocity along x and y as a share of max_speed, each limited by itself, and it has \
                       no heading and no other limit";
        match r.key("motion.kind", "", meaning, "").choice(Kind::Steered) {
            Kind::Steered => {
                let (motion, speeds) = Motion::read(r);
                (Mobility::Steered(motion), speeds)
            }
            Kind::Free => {
                let max_speed = Motion::read_max_speed(r);
                (Mobility::Free { max_speed }, between(LEAST, max_speed).or_zero().because("motion.max_speed"))
            }
        }
    }
}

impl Channel {
    fn read(r: &mut Reader<'_>, is_free: bool, summary: &Summary) -> Channel {
        let names = summary.class_names(&[AGENTS, POIS]);
        let of = Channel::of(r).names("names of classes, or \"agents\", or \"pois\"", true, names.as_deref(), |_| None);
        let alone = [AGENTS, POIS].into_iter().find(|name| of.len() > 1 && of.iter().any(|of| of == name));
        if let Some(name) = alone {
            r.report_key("agents.senses.of", format!("found {name:?} with other names, allowed alone"));
        }
        let groups = summary.group_names();
        let pois = Channel::pois(r).names("names of groups", false, groups.as_deref(), |_| None);
        let runs = runs(groups.as_deref().unwrap_or_default(), &pois);
        if runs > MAX_RANGES {
            let message =
                format!("found {runs} runs of neighbouring groups, allowed up to {MAX_RANGES}: reorder [[pois]]");
            r.report_key("agents.senses.pois", message);
        }
        if !pois.is_empty() && !of.is_empty() && of != [POIS] {
            r.report_key("agents.senses.pois", "found without of = \"pois\", allowed with it".into());
        }
        let sectors = match Channel::sectors(r).number_or(between(1, MAX_SECTORS), Sectors::EACH, 4) {
            Some(count) => Sectors::Equal(count),
            None => Sectors::Each(summary.named_by(&of, &pois)),
        };
        let frame = Channel::frame(r).choice(if is_free { Frame::Map } else { Frame::Heading });
        if is_free && frame == Frame::Heading {
            let message = "found \"heading\" with free motion, which has no heading; allowed \"map\"";
            r.report_key("agents.senses.frame", message.into());
        }
        let range = Channel::range(r).number(between(0.01, LONGEST).or_zero().or_unlimited(), f64::INFINITY);
        let measure = Channel::measure(r).choice(Measure::Linear);
        if matches!(measure, Measure::Distance | Measure::Closeness) && range.is_infinite() {
            let found = if r.has("agents.senses.range") { "found inf" } else { "missing" };
            let message = format!("{found}, allowed 0 to {LONGEST} with measure = \"{measure}\"");
            r.report_key("agents.senses.range", message);
        }
        let nearest = Channel::nearest(r).number(between(0.01, LONGEST), 1.0);
        let valued = of == [POIS];
        let value = summary.groups_of(&pois).map(|group| group.value).filter(|_| valued).fold(1.0, f64::max);
        let largest = measure.largest(nearest);
        if largest * value > MOST_MEASURED * (1.0 + 1e-9) {
            let times = if valued { format!(", times a POI's value of {value}") } else { String::new() };
            let message = format!(
                "found \"{measure}\", up to {largest} with nearest = {nearest}{times}; allowed up to {MOST_MEASURED}"
            );
            r.report_key("agents.senses.measure", message);
        }
        Channel {
            of,
            pois,
            sectors,
            frame,
            range,
            measure,
            nearest,
            combine: Channel::combine(r).choice(Combine::Share),
            empty: Channel::empty(r).number(sized(LEAST, 1e3), 0.0),
            gain: Channel::gain(r).number(between(1e-3, 1e3), 1.0),
        }
    }
}

/// Returns the number of runs of neighbours among the named ones of all groups.
fn runs(all: &[&str], named: &[String]) -> usize {
    let is_named: Vec<bool> = all.iter().map(|group| named.iter().any(|name| name == group)).collect();
    is_named.chunk_by(|a, b| a == b).filter(|run| run[0]).count()
}

impl Term {
    fn read(r: &mut Reader<'_>, summary: &Summary) -> Term {
        let names = summary.class_names(&[AGENTS]);
        let of = Term::of(r).names("names of classes, or \"agents\"", true, names.as_deref(), |_| None);
        if of.len() > 1 && of.iter().any(|of| of == AGENTS) {
            r.report_key("agents.rule.of", format!("found {AGENTS:?} with other names, allowed alone"));
        }
        let to = Term::to(r).required_number(between(0.01, LONGEST)).unwrap_or(LONGEST);
        let from = Term::from(r).number(between(0.01, to).or_zero().because("`to`"), 0.0);
        let size = sized(1e-3, 1e3);
        let gain = Term::gain(r).optional_number(size, "none: a term has either gain or align");
        let align = Term::align(r).optional_number(size, "none: a term has either gain or align");
        match (gain, align) {
            (None, None) => r.report_key("agents.rule.gain", "missing, allowed either this or `align`".into()),
            (Some(_), Some(_)) => r.report_key("agents.rule.align", "found with `gain`, allowed either of them".into()),
            _ => {}
        }
        Term { of, from, to, gain, align }
    }
}

impl PoiGroup {
    fn read(r: &mut Reader<'_>, index: usize, sides: [Allowed<f64>; 2], steps: usize, summary: &Summary) -> PoiGroup {
        let before = summary.groups.get(..index).unwrap_or_default();
        let name = PoiGroup::name(r).name(NAME, |name| name_problem(name, before.iter().map(|group| &group.name)));
        let limits = ("POIs", before.iter().map(|group| group.pois).sum(), MAX_POIS);
        let keys: [Key; 3] = [PoiGroup::at, PoiGroup::count, PoiGroup::region];
        let (at, count, region) = places(r, keys, ["pois.at", "pois.count", "pois.in"], sides, limits);
        let size = count.unwrap_or(at.len());
        let counts = if size == 0 { 0..=usize::MAX } else { size..=size };
        let errors = r.error_count();
        let names = summary.class_names(&[]);
        let observers = PoiGroup::observers(r).names("names of classes", false, names.as_deref(), |_| None);
        let named = summary.classes.iter().filter(|class| observers.contains(&class.name)).map(|class| class.agents);
        let counted = if observers.is_empty() { summary.observers() } else { named.sum() };
        let is_known = r.error_count() == errors && names.is_some() && !summary.classes.is_empty();
        if counted == 0 && is_known && summary.classes.iter().all(|class| class.agents > 0) {
            r.report_key("pois.observers", "missing, and no class observes; allowed names of classes".into());
        }
        // If the number is unknown, the reason is reported already.
        let most = if counted == 0 || !is_known { MAX_AGENTS } else { counted };
        let coupling =
            PoiGroup::coupling(r).one_or_each(between(1, most).because("the number of its observers"), counts, 3);
        let groups = summary.group_names();
        let after = PoiGroup::after(r).names("names of groups", false, groups.as_deref(), |_| None);
        if groups.is_some() && summary.cycle.first() == Some(&index) {
            let all = summary.cycle.iter().chain(&summary.cycle[..1]);
            let names: Vec<_> = all.map(|&group| format!("{:?}", summary.groups[group].name)).collect();
            r.report_key("pois.after", format!("found {}, which can never begin", names.join(" after ")));
        }
        PoiGroup {
            name,
            value: PoiGroup::value(r).number(between(1e-3, 1e3), 1.0),
            coupling,
            radius: PoiGroup::radius(r).number(between(0.01, LONGEST), 5.0),
            observers,
            windows: windows_of_group(r, steps, size),
            gone_within: PoiGroup::gone_within(r).number(between(0.01, LONGEST).or_zero(), 0.0),
            score: PoiGroup::score(r).choice(Score::Observed),
            when: PoiGroup::when(r).choice(When::Ever),
            after,
            at,
            count,
            region,
        }
    }
}

/// Reads the windows of a group of POIs, one per POI or one for all.
fn windows_of_group(r: &mut Reader<'_>, steps: usize, pois: usize) -> Vec<[usize; 2]> {
    let windows = windows(PoiGroup::windows(r), ("pois.at, or one for all", None), steps);
    match windows.len() {
        count if count <= 1 || count == pois || pois == 0 => windows,
        count => {
            let message =
                format!("found a list of {count}, allowed a list of {pois} {WINDOWS}, or of one for all, or none");
            r.report_key("pois.windows", message);
            vec![]
        }
    }
}
