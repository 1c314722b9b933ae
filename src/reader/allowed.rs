//! The allowed values of a number.

use std::fmt::{self, Display};

use serde::Serialize;

use super::value::{Kind, Value};

/// The allowed values of a number.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Allowed<T> {
    low: T,
    pub(crate) high: T,
    zero: bool,
    unlimited: bool,
    /// The open interval in which only 0 is allowed, if any.
    gap: Option<[T; 2]>,
    /// The keys that set the bounds.
    pub(super) because: &'static str,
}

/// Returns the range from `low` to `high`, both included.
pub(crate) fn between<T>(low: T, high: T) -> Allowed<T> {
    Allowed { low, high, zero: false, unlimited: false, gap: None, because: "" }
}

/// Returns the range of 0 and of numbers whose size is from `least` to `most`.
pub(crate) fn sized(least: f64, most: f64) -> Allowed<f64> {
    Allowed { gap: Some([-least, least]), ..between(-most, most) }
}

impl<T: Number> Allowed<T> {
    /// Also allows 0, below the minimum.
    pub(crate) fn or_zero(self) -> Self {
        Allowed { zero: true, ..self }
    }

    /// Also allows infinity.
    pub(crate) fn or_unlimited(self) -> Self {
        Allowed { unlimited: true, ..self }
    }

    /// Names the keys that set the bounds.
    pub fn because(self, because: &'static str) -> Self {
        Allowed { because, ..self }
    }

    pub(super) fn holds(&self, value: T) -> bool {
        (self.low..=self.high).contains(&value) && !self.is_in_gap(value)
            || self.zero && value == T::ZERO
            || self.unlimited && value.is_infinite()
    }

    /// Reports whether the value is nearer to 0 than the smallest allowed number other than 0.
    pub(super) fn is_too_small(&self, value: T) -> bool {
        self.zero && T::ZERO < value && value < self.low || self.is_in_gap(value)
    }

    fn is_in_gap(&self, value: T) -> bool {
        self.gap.is_some_and(|[from, to]| from < value && value < to && value != T::ZERO)
    }

    /// Returns the default, or the bound next to it if other keys exclude it.
    pub(super) fn nearest(&self, default: T) -> T {
        match default {
            _ if self.holds(default) => default,
            _ if default < self.low => self.low,
            _ => self.high,
        }
    }
}

impl<T: Number> Allowed<T> {
    /// Returns the range for any config. A bound that depends on other keys is written as their names.
    pub(super) fn in_general(&self) -> String {
        match self.because {
            "" => self.in_detail(),
            both if both.contains(" to ") => both.into(),
            most => format!("{}{} to {most}", if self.zero { "0 or " } else { "" }, self.low),
        }
    }

    /// Returns the range, including the gap between 0 and the smallest other number.
    pub(super) fn in_detail(&self) -> String {
        if let Some([from, to]) = self.gap {
            return format!("{} to {from} or 0 or {to} to {}", self.low, self.high);
        }
        match (self.zero, self.low < self.high) {
            (true, true) => format!("0 or {}", Allowed { zero: false, ..*self }),
            _ => self.to_string(),
        }
    }
}

/// Writes the range without the gap above 0. Only readers who wrote a number in that gap need [`Allowed::in_detail`].
impl<T: Number> Display for Allowed<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Allowed { low, high, .. } = self;
        match (self.zero, low.partial_cmp(high)) {
            (true, Some(std::cmp::Ordering::Less)) => write!(f, "0 to {high}")?,
            (true, _) => write!(f, "0")?,
            (false, Some(std::cmp::Ordering::Less)) => write!(f, "{low} to {high}")?,
            (false, _) => write!(f, "{high}")?,
        }
        if self.unlimited {
            write!(f, " or inf (unlimited)")?;
        }
        if !self.because.is_empty() {
            write!(f, " ({})", self.because)?;
        }
        Ok(())
    }
}

/// A type of numbers in a config.
pub(crate) trait Number: Copy + PartialOrd + Display + Serialize {
    /// The number 0.
    const ZERO: Self;
    /// The name of the type with its article: "a number".
    const KIND: &'static str;

    /// Returns the number of a value: `None` for another kind of value, `Some(None)` for a number outside the type.
    fn read(value: &Value<'_>) -> Option<Option<Self>>;

    /// Reports whether the number is infinity.
    fn is_infinite(self) -> bool {
        false
    }
}

impl Number for f64 {
    const ZERO: f64 = 0.0;
    const KIND: &'static str = "a number";

    fn read(value: &Value<'_>) -> Option<Option<f64>> {
        match value.kind {
            Kind::Integer(_) => i64::read(value).map(|integer| integer.map(|integer| integer as f64)),
            // Adding 0 turns -0 into 0.
            Kind::Float(number) => Some(number.map(|number| number + 0.0)),
            _ => None,
        }
    }

    fn is_infinite(self) -> bool {
        self == f64::INFINITY
    }
}

macro_rules! whole_number {
    ($($type:ty)*) => {$(
        impl Number for $type {
            const ZERO: $type = 0;
            const KIND: &'static str = "a whole number";

            fn read(value: &Value<'_>) -> Option<Option<$type>> {
                match value.kind {
                    Kind::Integer(number) => Some(number.and_then(|number| number.try_into().ok())),
                    _ => None,
                }
            }
        }
    )*};
}
whole_number!(i64 u64 usize);
