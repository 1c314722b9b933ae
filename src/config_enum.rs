//! Enums whose variants are words in configs and messages, and constants in shaders.

use serde::Serialize;

/// An enum whose variants are words, see `config_enum!`.
pub trait Choice: Copy + Serialize + 'static {
    /// Every word with its variant, ordered by number.
    const ALL: &'static [(&'static str, Self)];

    /// Returns the words, for a command line's list of possible values.
    fn names() -> impl Iterator<Item = &'static str> {
        Self::ALL.iter().map(|&(name, _)| name)
    }
}

/// Defines an enum whose variants are words in configs and messages, and constants in shaders. For `Density::Linear`, `wgsl`
/// returns `const DENSITY_LINEAR: u32 = 0u;`.
macro_rules! config_enum {
    ($(#[$doc:meta])* $name:ident { $($(#[$variant_doc:meta])* $variant:ident = $word:literal,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
        pub enum $name {
            $($(#[$variant_doc])* #[serde(rename = $word)] $variant,)*
        }

        impl $crate::config_enum::Choice for $name {
            const ALL: &'static [(&'static str, Self)] = &[$(($word, Self::$variant),)*];
        }

        impl $name {
            /// Returns the variant with a number.
            pub const fn of(number: u32) -> $name {
                <$name as $crate::config_enum::Choice>::ALL[number as usize].1
            }

            /// Returns the variants' numbers as WGSL constants.
            pub fn wgsl() -> String {
                let words = [$((stringify!($variant), $name::$variant as u32)),*];
                let name = |word: &str| format!("{}_{}", stringify!($name), word).to_uppercase();
                words.map(|(word, number)| format!("const {}: u32 = {number}u;\n", name(word))).concat()
            }
        }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.pad(match self { $(Self::$variant => $word,)* })
            }
        }
    };
}
pub(crate) use config_enum;

#[cfg(test)]
mod tests {
    use super::*;

    config_enum! {
        /// For a test.
        Colour {
            Red = "red",
            DarkGreen = "dark-green",
        }
    }

    #[test]
    fn a_word_is_the_same_number_everywhere() {
        assert_eq!(Colour::wgsl(), "const COLOUR_RED: u32 = 0u;\nconst COLOUR_DARKGREEN: u32 = 1u;\n");
        for (number, (word, colour)) in (0..).zip(Colour::ALL) {
            assert_eq!((Colour::of(number), *colour as u32, colour.to_string()), (*colour, number, word.to_string()));
        }
        assert_eq!(Colour::names().collect::<Vec<_>>(), ["red", "dark-green"]);
    }
}
