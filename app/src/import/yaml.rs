//! YAML as a tree of values that know their lines and their paths.

use std::fmt;

use serde::de::{Deserialize, Deserializer, MapAccess, SeqAccess, Visitor};
use serde_saphyr::{Spanned, UserMessageFormatter};
use toml::Value;

use flotilla::config::Problem;

/// A value of a YAML file, with its line.
pub(super) type Node = Spanned<Tree>;

/// A value of a YAML file.
#[derive(Clone, Debug)]
pub(super) enum Tree {
    Null,
    Scalar(Value),
    List(Vec<Node>),
    Map(Vec<(String, Node)>),
}

struct Reader;

impl<'de> Visitor<'de> for Reader {
    type Value = Tree;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a value")
    }

    fn visit_unit<E>(self) -> Result<Tree, E> {
        Ok(Tree::Null)
    }

    fn visit_bool<E>(self, value: bool) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_i64<E>(self, value: i64) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_u64<E>(self, value: u64) -> Result<Tree, E> {
        Ok(Tree::Scalar(i64::try_from(value).map_or(Value::from(value as f64), Value::from)))
    }

    fn visit_f64<E>(self, value: f64) -> Result<Tree, E> {
        Ok(Tree::Scalar(value.into()))
    }

    fn visit_str<E>(self, text: &str) -> Result<Tree, E> {
        Ok(Tree::Scalar(evaluate(text).unwrap_or(text.into())))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Tree, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element()? {
            list.push(item);
        }
        Ok(Tree::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<Tree, A::Error> {
        let mut map = Vec::new();
        while let Some(entry) = entries.next_entry()? {
            map.push(entry);
        }
        Ok(Tree::Map(map))
    }
}

impl<'de> Deserialize<'de> for Tree {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Tree, D::Error> {
        deserializer.deserialize_any(Reader)
    }
}

/// Returns the value of a product or quotient of numbers, such as `5*20` or `3.14159/2`. The authors' configs have these
/// with the tag `!eval`.
fn evaluate(text: &str) -> Option<Value> {
    let (mut value, mut divides) = (1.0, false);
    for part in text.split_inclusive(['*', '/']) {
        let number: f64 = part.trim_end_matches(['*', '/']).trim().parse().ok()?;
        value = if divides { value / number } else { value * number };
        divides = part.ends_with('/');
    }
    let is_whole = !text.contains('.') && value.fract() == 0.0 && value.abs() < 1e15;
    let is_number = value.is_finite() && text.ends_with(|last: char| last.is_ascii_digit() || last == '.');
    is_number.then(|| if is_whole { Value::from(value as i64) } else { Value::from(value) })
}

/// Reads a text. Limits on its depth and its aliases keep time and memory in proportion to its length.
pub(super) fn parse(text: &str) -> Result<Node, Problem> {
    // Many agents may be aliases of one.
    let options = serde_saphyr::options! {
        with_snippet: false,
        budget: serde_saphyr::budget! { enforce_alias_anchor_ratio: false },
        // The check of the config refuses them with their line. Keys that are not translated may have them.
        non_finite_float_policy: serde_saphyr::NonFiniteFloatPolicy::PassThrough,
        // The authors' programs read 010 as 8.
        legacy_octal_numbers: true,
    };
    serde_saphyr::from_str_with_options(text, options).map_err(|error| {
        let line = error.location().map(|location| location.line() as usize);
        let found = error.render_with_formatter(&UserMessageFormatter);
        let advice = match () {
            () if text.parse::<toml::Table>().is_ok() => "; it is TOML, as configs of this program are",
            () if found.contains("duplicate") => "; remove one of both (the authors' programs take the last)",
            () => "",
        };
        Problem { line, key: String::new(), message: format!("not YAML that can be read: {found}{advice}") }
    })
}

impl Tree {
    /// Returns a value without tables and nulls as TOML.
    fn to_toml(&self) -> Option<Value> {
        match self {
            Tree::Scalar(value) => Some(value.clone()),
            Tree::List(items) => items.iter().map(|item| item.value.to_toml()).collect::<Option<_>>().map(Value::Array),
            Tree::Null | Tree::Map(_) => None,
        }
    }
}

/// A value with its path.
#[derive(Clone, Debug)]
pub(super) struct At<'a> {
    node: &'a Node,
    /// The path from the root, such as `env.agents.rovers[0].position`.
    pub path: String,
}

impl<'a> At<'a> {
    pub fn root(node: &'a Node) -> At<'a> {
        At { node, path: String::new() }
    }

    pub fn line(&self) -> usize {
        self.node.referenced.line() as usize
    }

    pub fn is_null(&self) -> bool {
        matches!(self.node.value, Tree::Null)
    }

    /// Returns a problem with this value.
    pub fn problem(&self, message: impl Into<String>) -> Problem {
        Problem { line: Some(self.line()), key: self.path.clone(), message: message.into() }
    }

    fn wrong(&self, allowed: &str) -> Problem {
        self.problem(format!("found {}, allowed {allowed}", self.shown()))
    }

    fn below(&self, key: &str, node: &'a Node) -> At<'a> {
        let dot = if self.path.is_empty() { "" } else { "." };
        At { node, path: format!("{}{dot}{key}", self.path) }
    }

    /// Returns the value at a dotted path, unless it is missing or null.
    pub fn get(&self, path: &str) -> Option<At<'a>> {
        let mut node = self.node;
        for key in path.split('.') {
            let Tree::Map(entries) = &node.value else { return None };
            node = entries.iter().find(|(other, _)| other == key).map(|(_, node)| node)?;
        }
        Some(self.below(path, node)).filter(|at| !at.is_null())
    }

    /// Returns the value at a dotted path, or the problem that it is missing.
    pub fn need(&self, path: &str) -> Result<At<'a>, Problem> {
        self.get(path).ok_or_else(|| self.below(path, self.node).problem("missing, and the translation needs it"))
    }

    /// Returns the items of a list, or none if it is missing.
    pub fn list(&self, path: &str) -> Result<Vec<At<'a>>, Problem> {
        self.get(path).map_or(Ok(vec![]), |list| list.items())
    }

    pub fn items(&self) -> Result<Vec<At<'a>>, Problem> {
        let Tree::List(items) = &self.node.value else { return Err(self.wrong("a list")) };
        Ok(items.iter().enumerate().map(|(i, node)| At { node, path: format!("{}[{i}]", self.path) }).collect())
    }

    pub fn number(&self) -> Result<f64, Problem> {
        match &self.node.value {
            Tree::Scalar(Value::Integer(number)) => Ok(*number as f64),
            Tree::Scalar(Value::Float(number)) if !number.is_nan() => Ok(*number),
            _ => Err(self.wrong("a number")),
        }
    }

    /// Returns the index of one of `count` agents.
    pub fn agent(&self, count: usize) -> Result<usize, Problem> {
        let number = self.number()?;
        let index = (0..count).find(|&index| index as f64 == number);
        index.ok_or_else(|| self.wrong(&format!("one of {count} agents, from 0")))
    }

    /// Returns the number at a path, or the default if it is missing.
    pub fn number_or(&self, path: &str, default: f64) -> Result<f64, Problem> {
        self.get(path).map_or(Ok(default), |at| at.number())
    }

    pub fn point(&self) -> Result<[f64; 2], Problem> {
        match &self.items()?[..] {
            [x, y] => Ok([x.number()?, y.number()?]),
            _ => Err(self.wrong("a position [x, y]")),
        }
    }

    /// Returns what replaces the word at a path, or the `default` if it is missing.
    pub fn word<T: Copy>(&self, path: &str, default: &str, words: &[(&str, T)]) -> Result<T, Problem> {
        let at = self.get(path);
        let found = at.as_ref().map_or(default.into(), At::shown);
        let word = words.iter().find(|(word, _)| found.trim_matches(['"', ',']) == *word);
        let allowed = || words.iter().map(|(word, _)| *word).collect::<Vec<_>>().join(", ");
        word.map(|(_, ours)| *ours).ok_or_else(|| at.unwrap_or(self.below(path, self.node)).wrong(&allowed()))
    }

    /// Returns a value without tables as TOML.
    pub fn value(&self) -> Result<Value, Problem> {
        self.node.value.to_toml().ok_or_else(|| self.wrong("a value or a list of values"))
    }

    /// Returns the value as people see it, shortened.
    pub fn shown(&self) -> String {
        let text = match &self.node.value {
            Tree::Null => "null".into(),
            _ => self.node.value.to_toml().map_or("a section".into(), |value| value.to_string()),
        };
        let kept: String = text.replace('\n', " ").chars().take(60).collect();
        if kept.len() < text.len() { kept + "…" } else { kept }
    }

    /// Returns the values below this one that are not sections, or this value if it is none.
    pub fn leaves(&self) -> Vec<At<'a>> {
        match &self.node.value {
            Tree::Map(entries) if !entries.is_empty() => {
                entries.iter().flat_map(|(key, node)| self.below(key, node).leaves()).collect()
            }
            Tree::List(_) if self.node.value.to_toml().is_none() => {
                self.items().into_iter().flatten().flat_map(|item| item.leaves()).collect()
            }
            _ => vec![self.clone()],
        }
    }
}
