//! What is declared once and has several forms: structs that the host and its shaders share, and choices among words.

use bytemuck::Pod;
use fearless_simd::{Simd, prelude::*};
use serde::Serialize;

/// A type that fields of shared structs have: 32 bits, a list of those, or another shared struct.
pub trait Field: Pod {
    /// One team a lane: a float in every lane, all else as it is.
    type Lanes<S: Simd>: Copy;

    /// The value so.
    fn lanes<S: Simd>(self, simd: S) -> Self::Lanes<S>;

    /// The lines of a WGSL struct that declare such a field.
    fn declared(name: &str) -> String;
}

impl Field for u32 {
    type Lanes<S: Simd> = u32;

    fn lanes<S: Simd>(self, _: S) -> u32 {
        self
    }

    fn declared(name: &str) -> String {
        format!("    {name}: u32,\n")
    }
}

impl Field for f32 {
    type Lanes<S: Simd> = S::f32s;

    fn lanes<S: Simd>(self, simd: S) -> S::f32s {
        S::f32s::simd_from(simd, self)
    }

    fn declared(name: &str) -> String {
        format!("    {name}: f32,\n")
    }
}

macro_rules! lists {
    ($($of:ident)*) => {$(
        impl<const N: usize> Field for [$of; N] {
            type Lanes<S: Simd> = [$of; N];

            fn lanes<S: Simd>(self, _: S) -> [$of; N] {
                self
            }

            fn declared(name: &str) -> String {
                format!("    {name}: array<{}, {N}>,\n", stringify!($of))
            }
        }
    )*};
}
lists!(u32 f32);

/// A struct that lies in memory as its shaders read it: see `shared!`.
pub trait Shared: Pod {
    /// What the shaders call it too.
    const NAME: &'static str;

    /// Its fields as WGSL has them; those of a shared struct within it stand among its own.
    fn fields() -> String;

    /// Its fields' names.
    fn names() -> &'static [&'static str];

    /// `struct Name { … }`
    fn wgsl() -> String {
        format!("struct {} {{\n{}}}\n", Self::NAME, Self::fields())
    }

    /// The WGSL expression of this value, of a struct of whole numbers.
    fn value(&self) -> String {
        let words: Vec<String> = bytemuck::cast_slice(&[*self]).iter().map(|word: &u32| format!("{word}u")).collect();
        format!("{}({})", Self::NAME, words.join(", "))
    }

    /// The WGSL expression of such a struct whose fields are those of another struct.
    fn copied_from(other: &str) -> String {
        let fields: Vec<String> = Self::names().iter().map(|name| format!("{other}.{name}")).collect();
        format!("{}({})", Self::NAME, fields.join(", "))
    }
}

/// Declares structs that a shader shares with the host: of every field one line makes the `#[repr(C)]` type and the
/// WGSL text, and of a struct `as` another the latter, the form with every float in all lanes.
///
/// All that is in them has 32 bits, so that nothing is padded on either side.
macro_rules! shared {
    () => {};
    ($(#[$about:meta])* pub struct $name:ident as $lanes:ident { $($fields:tt)+ } $($more:tt)*) => {
        $crate::declare::shared! { @struct $(#[$about])* $name { $($fields)+ } }
        $crate::declare::shared! { @lanes $name $lanes { $($fields)+ } }
        $crate::declare::shared! { $($more)* }
    };
    ($(#[$about:meta])* pub struct $name:ident { $($fields:tt)+ } $($more:tt)*) => {
        $crate::declare::shared! { @struct $(#[$about])* $name { $($fields)+ } }
        $crate::declare::shared! { $($more)* }
    };
    (@struct $(#[$about:meta])* $name:ident { $($(#[$doc:meta])* pub $field:ident: $type:ty,)+ }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        pub struct $name { $($(#[$doc])* pub $field: $type,)+ }

        const _: () = assert!(align_of::<$name>() == 4);

        impl $crate::declare::Shared for $name {
            const NAME: &'static str = stringify!($name);

            fn fields() -> String {
                [$(<$type as $crate::declare::Field>::declared(stringify!($field))),+].concat()
            }

            fn names() -> &'static [&'static str] {
                &[$(stringify!($field)),+]
            }
        }
    };
    (@lanes $name:ident $lanes:ident { $($(#[$doc:meta])* pub $field:ident: $type:ty,)+ }) => {
        #[doc = concat!("[`", stringify!($name), "`] with every float in all lanes: operations take it from memory.")]
        #[derive(Clone, Copy)]
        pub struct $lanes<S: fearless_simd::Simd> {
            $($(#[$doc])* pub $field: <$type as $crate::declare::Field>::Lanes<S>,)+
        }

        impl $crate::declare::Field for $name {
            type Lanes<S: fearless_simd::Simd> = $lanes<S>;

            fn lanes<S: fearless_simd::Simd>(self, simd: S) -> $lanes<S> {
                $lanes { $($field: $crate::declare::Field::lanes(self.$field, simd),)+ }
            }

            fn declared(_: &str) -> String {
                <$name as $crate::declare::Shared>::fields()
            }
        }
    };
}
pub(crate) use shared;

/// A key whose value is one of a few words: see `config_enum!`.
pub trait Choice: Copy + Serialize + 'static {
    /// Every word with what it stands for; its place is its number.
    const ALL: &'static [(&'static str, Self)];

    /// The words, for a command line's list of possible values.
    fn names() -> impl Iterator<Item = &'static str> {
        Self::ALL.iter().map(|&(name, _)| name)
    }
}

/// What is to be done for each word of a choice by code of its own: the word's number is a constant of the compiler's.
pub trait Fixed {
    /// What it comes to.
    type Output;

    /// Does it for the word of this number.
    fn with<const WORD: u32>(self) -> Self::Output;
}

/// Defines an enum whose variants are written in configs as the words given, and in shaders as constants: `wgsl` has
/// `const DENSITY_LINEAR: u32 = 0u;` for what is `Density::Linear` here.
macro_rules! config_enum {
    ($(#[$doc:meta])* $name:ident { $($(#[$variant_doc:meta])* $variant:ident = $word:literal,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize)]
        pub enum $name {
            $($(#[$variant_doc])* #[serde(rename = $word)] $variant,)*
        }

        impl $crate::declare::Choice for $name {
            const ALL: &'static [(&'static str, Self)] = &[$(($word, Self::$variant),)*];
        }

        impl $name {
            /// The word of a number.
            pub const fn of(number: u32) -> $name {
                <$name as $crate::declare::Choice>::ALL[number as usize].1
            }

            /// Does what is to be done for this word.
            #[inline(always)]
            pub fn fix<F: $crate::declare::Fixed>(self, fixed: F) -> F::Output {
                match self { $($name::$variant => fixed.with::<{ $name::$variant as u32 }>(),)* }
            }

            /// The words' numbers as constants of a shader.
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
    use fearless_simd::{Level, dispatch};

    use super::*;

    config_enum! {
        /// Of a test.
        Colour {
            Red = "red",
            DarkGreen = "dark-green",
        }
    }

    shared! {
        /// Of a test.
        pub struct Inner as InnerLanes {
            pub size: f32,
            pub count: u32,
        }

        pub struct Outer {
            pub first: u32,
            pub inner: Inner,
            pub list: [f32; 3],
            pub numbers: [u32; 2],
        }

        pub struct Duo {
            pub size: u32,
            pub count: u32,
        }
    }

    /// The number that the compiler was given.
    struct Given;

    impl Fixed for Given {
        type Output = u32;

        fn with<const WORD: u32>(self) -> u32 {
            WORD
        }
    }

    #[test]
    fn a_word_is_the_same_number_everywhere() {
        assert_eq!(Colour::wgsl(), "const COLOUR_RED: u32 = 0u;\nconst COLOUR_DARKGREEN: u32 = 1u;\n");
        for (number, (word, colour)) in (0..).zip(Colour::ALL) {
            assert_eq!(
                (Colour::of(number), colour.fix(Given), colour.to_string()),
                (*colour, number, word.to_string())
            );
        }
        assert_eq!(Colour::names().collect::<Vec<_>>(), ["red", "dark-green"]);
    }

    #[test]
    fn a_shared_struct_reads_alike_in_wgsl() {
        let text = "struct Outer {\n    first: u32,\n    size: f32,\n    count: u32,\n    list: array<f32, 3>,\n    \
                    numbers: array<u32, 2>,\n}\n";
        assert_eq!(Outer::wgsl(), text);
        let outer = Outer { first: 1, inner: Inner { size: 2.5, count: 3 }, list: [4.0, 5.0, 6.0], numbers: [7, 8] };
        let words = [1, 2.5f32.to_bits(), 3, 4f32.to_bits(), 5f32.to_bits(), 6f32.to_bits(), 7, 8];
        assert_eq!(bytemuck::cast_slice::<_, u32>(&[outer]), words);
        assert_eq!(Duo { size: 7, count: 8 }.value(), "Duo(7u, 8u)");
        assert_eq!(Duo::copied_from("world"), "Duo(world.size, world.count)");
    }

    #[test]
    fn every_lane_holds_the_number() {
        fn lanes<S: Simd>(simd: S, inner: Inner) -> (Vec<f32>, u32) {
            let lanes = inner.lanes(simd);
            ((0..S::f32s::LEN).map(|lane| lanes.size[lane]).collect(), lanes.count)
        }
        let (sizes, count) = dispatch!(Level::new(), simd => lanes(simd, Inner { size: 2.5, count: 3 }));
        assert!(sizes.len() >= 4 && sizes.iter().all(|&size| size == 2.5) && count == 3, "{sizes:?}");
    }
}
