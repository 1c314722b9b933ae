//! Values of configs, as written in a text or set by a program.

use std::borrow::Cow;

use toml::Spanned;
use toml::de::DeValue;

/// A value of a config.
#[derive(Clone)]
pub(crate) struct Value<'a> {
    pub(super) kind: Kind<'a>,
    /// The offset and the text of a value that was written.
    pub(super) written: Option<(usize, &'a str)>,
    /// The name of the override that set it in a table of a list.
    pub(super) set_by: Option<&'a str>,
}

/// The content of a [`Value`].
#[derive(Clone)]
pub(super) enum Kind<'a> {
    /// A whole number. `None` is one that TOML cannot represent.
    Integer(Option<i128>),
    /// Another number. `None` is NaN, or a number that is too large for `f64`.
    Float(Option<f64>),
    Word(Cow<'a, str>),
    Flag(bool),
    List(Vec<Value<'a>>),
    /// Keys without dots, each with its value.
    Table(Vec<(String, Value<'a>)>),
    /// A value of a type that no key has. The text describes it in errors if it was not written.
    Other(String),
}

impl<'a> Value<'a> {
    /// Returns a value of a parsed text.
    pub(super) fn of_text(value: Spanned<DeValue<'a>>, text: &'a str) -> Value<'a> {
        let span = value.span();
        let written = Some((span.start, text.get(span).unwrap_or_default()));
        let kind = match value.into_inner() {
            DeValue::Integer(integer) => Kind::Integer(i128::from_str_radix(integer.as_str(), integer.radix()).ok()),
            DeValue::Float(float) => {
                let is_exact = |value: &f64| value.is_finite() || float.as_str().contains("inf");
                Kind::Float(float.as_str().parse().ok().filter(is_exact))
            }
            DeValue::String(word) => Kind::Word(word),
            DeValue::Array(items) => Kind::List(items.into_iter().map(|item| Value::of_text(item, text)).collect()),
            DeValue::Table(items) => Kind::Table(
                items.into_iter().map(|(key, value)| (key.into_inner().into(), Value::of_text(value, text))).collect(),
            ),
            DeValue::Boolean(flag) => Kind::Flag(flag),
            DeValue::Datetime(_) => Kind::Other(String::new()),
        };
        Value { kind, written, set_by: None }
    }

    /// Returns the value of a field. Whole numbers above the range of TOML are kept as such.
    pub(crate) fn of(field: &impl serde::Serialize) -> Value<'a> {
        let kind = match toml::Value::try_from(field) {
            Ok(value) => return value.into(),
            Err(_) => Kind::Integer(None),
        };
        Value { kind, written: None, set_by: None }
    }

    /// Returns a table without keys.
    pub(super) fn empty_table() -> Value<'a> {
        Value { kind: Kind::Table(vec![]), written: None, set_by: None }
    }

    /// Sets a value in nested lists and tables. In a list, a part of the path is the `name` of a table or an index. In a table
    /// it is a key: `["uav", "senses", "2", "range"]`.
    ///
    /// # Errors
    /// A list has no such table or item, or a value is neither a list nor a table.
    pub(super) fn set(&mut self, path: &[&str], value: Value<'a>) -> Result<(), String> {
        let &[first, ref rest @ ..] = path else {
            *self = value;
            return Ok(());
        };
        let found = self.found();
        match &mut self.kind {
            Kind::List(items) => {
                let named = items.iter().position(|item| item.name() == Some(first));
                let index = named.or_else(|| first.parse().ok()).filter(|&index| index < items.len());
                let Some(index) = index else {
                    let names: Vec<&str> = items.iter().filter_map(Value::name).collect();
                    let names = if names.is_empty() { "".into() } else { format!(", allowed {}", names.join(", ")) };
                    return Err(format!("found no {} in {found}{names}", shorten(first)));
                };
                items[index].set(rest, value)
            }
            Kind::Table(items) => {
                let index = items.iter().position(|(key, _)| key == first).unwrap_or_else(|| {
                    items.push((first.into(), Value { set_by: value.set_by, ..Value::empty_table() }));
                    items.len() - 1
                });
                items[index].1.set(rest, value)
            }
            _ => Err(format!("found {found}, which has no key {}", shorten(first))),
        }
    }

    /// Returns the name of a table in a list.
    fn name(&self) -> Option<&str> {
        self.key("name")?.word()
    }

    /// Returns the value of a key of a table.
    pub(crate) fn key(&self, key: &str) -> Option<&Value<'a>> {
        self.table()?.iter().find(|(name, _)| name == key).map(|(_, value)| value)
    }

    /// Returns the items of a list.
    pub(crate) fn list(&self) -> Option<&[Value<'a>]> {
        if let Kind::List(items) = &self.kind { Some(items) } else { None }
    }

    /// Returns the keys of a table.
    pub(crate) fn table(&self) -> Option<&[(String, Value<'a>)]> {
        if let Kind::Table(items) = &self.kind { Some(items) } else { None }
    }

    /// Returns `true` or `false`.
    pub(crate) fn flag(&self) -> Option<bool> {
        if let Kind::Flag(flag) = self.kind { Some(flag) } else { None }
    }

    /// Returns a word.
    pub(crate) fn word(&self) -> Option<&str> {
        if let Kind::Word(word) = &self.kind { Some(word) } else { None }
    }

    /// Describes the value in errors.
    pub(crate) fn found(&self) -> String {
        match (&self.kind, self.written) {
            (Kind::List(items), _) => format!("a list of {}", items.len()),
            (Kind::Table(_), _) => "a table".into(),
            (_, Some((_, text))) => shorten(text),
            (Kind::Integer(None), None) => format!("a number above {}", i64::MAX),
            (Kind::Float(None), None) => "nan".into(),
            (Kind::Other(text), None) => text.clone(),
            (_, None) => self.to_toml().map_or(String::new(), |value| shorten(&value.to_string())),
        }
    }

    /// Returns the value as TOML, if a key can have it.
    pub(crate) fn to_toml(&self) -> Option<toml::Value> {
        match &self.kind {
            Kind::Integer(number) => i64::try_from((*number)?).ok().map(toml::Value::Integer),
            Kind::Float(number) => Some(number.unwrap_or(f64::NAN).into()),
            Kind::Word(word) => Some(word.clone().into_owned().into()),
            Kind::Flag(flag) => Some((*flag).into()),
            Kind::List(items) => items.iter().map(Value::to_toml).collect::<Option<Vec<_>>>().map(toml::Value::Array),
            Kind::Table(items) => {
                let of = |(key, value): &(String, Value<'_>)| Some((key.clone(), value.to_toml()?));
                items.iter().map(of).collect::<Option<toml::Table>>().map(toml::Value::Table)
            }
            Kind::Other(_) => None,
        }
    }
}

/// Fails for whole numbers above the range of TOML.
impl serde::Serialize for Value<'_> {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let value = self.to_toml().ok_or_else(|| serde::ser::Error::custom(format!("{} is not TOML", self.found())))?;
        value.serialize(serializer)
    }
}

impl From<toml::Value> for Value<'_> {
    fn from(value: toml::Value) -> Self {
        let kind = match value {
            toml::Value::Integer(number) => Kind::Integer(Some(number.into())),
            toml::Value::Float(number) => Kind::Float(Some(number).filter(|number| !number.is_nan())),
            toml::Value::String(word) => Kind::Word(word.into()),
            toml::Value::Array(items) => Kind::List(items.into_iter().map(Value::from).collect()),
            toml::Value::Boolean(flag) => Kind::Flag(flag),
            toml::Value::Table(items) => {
                Kind::Table(items.into_iter().map(|(key, value)| (key, value.into())).collect())
            }
            other => Kind::Other(other.to_string()),
        };
        Value { kind, written: None, set_by: None }
    }
}

/// Shortens a text from the file to a part of one line.
pub(super) fn shorten(text: &str) -> String {
    let line = text.lines().next().unwrap_or_default();
    let end = line.char_indices().nth(40).map_or(line.len(), |(end, _)| end);
    let more = if end < text.len() { "…" } else { "" };
    line[..end].chars().map(|c| if c.is_control() { ' ' } else { c }).chain(more.chars()).collect()
}
