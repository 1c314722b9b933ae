//! Pictures, films, pages and comparisons of runs.
//!
//! | module | contents |
//! |---|---|
//! | [`scene`] | a picture described once, written as SVG, PDF or PNG |
//! | [`letters`], [`pdf`] | its text as outlines; its PDF form |
//! | [`map`] | a team on its map: agents, POIs, trails |
//! | [`curves`] | learning curves: mean and standard error over trials, and their figure |
//! | [`runs`] | reading the curves of run directories, with errors |
//! | [`comparison`] | comparison of arms, with intervals and tests |
//! | [`grid`] | heat maps and curves over the axes of a sweep |
//! | [`replay`] | episodes of any trial and generation, as a page or a picture |
//! | [`table`] | text tables, for people and for LaTeX |

/// Implements `Display` and `FromStr` for an enum by the names that serde gives its variants.
macro_rules! named_by_serde {
    ($name:ident, $allowed:literal) => {
        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                serde::Serialize::serialize(self, f)
            }
        }
        impl std::str::FromStr for $name {
            type Err = String;
            fn from_str(text: &str) -> Result<$name, String> {
                let text = serde::de::IntoDeserializer::into_deserializer(text);
                $name::deserialize(text).map_err(|_: serde::de::value::Error| concat!("allowed ", $allowed).into())
            }
        }
    };
}

pub mod comparison;
pub mod curves;
pub mod grid;
pub mod letters;
pub mod map;
pub mod pdf;
pub mod replay;
pub mod runs;
pub mod scene;
pub mod table;
