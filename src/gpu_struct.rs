//! Structs and constants that the host shares with its shaders.

use bytemuck::Pod;
use fearless_simd::{Simd, prelude::*};

/// The type of a field of a GPU struct: 32 bits, an array of those, or another GPU struct.
pub trait Field: Pod {
    /// The type with one team per lane: `f32` is copied to all lanes, other fields keep their type.
    type Lanes<S: Simd>: Copy;

    /// Converts a value to [`Field::Lanes`].
    fn lanes<S: Simd>(self, simd: S) -> Self::Lanes<S>;

    /// Returns the WGSL lines that declare a field of this type.
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

/// The type of a constant that a shader shares with the host.
pub trait Constant {
    /// Returns the declaration in WGSL: `const NAME: type = value;`.
    fn declared(self, name: &str) -> String;
}

impl Constant for u32 {
    fn declared(self, name: &str) -> String {
        format!("const {name}: u32 = {self}u;\n")
    }
}

impl Constant for usize {
    fn declared(self, name: &str) -> String {
        u32::try_from(self).expect("shared numbers have 32 bits").declared(name)
    }
}

impl Constant for bool {
    fn declared(self, name: &str) -> String {
        format!("const {name}: bool = {self};\n")
    }
}

impl Constant for f32 {
    fn declared(self, name: &str) -> String {
        let (exponent, mantissa) = (self.to_bits() >> 23, self.to_bits() & 0x7f_ffff);
        assert!(mantissa == 0 && (1..255).contains(&exponent), "{name} is no power of two, whose digits are exact");
        format!("const {name}: f32 = 0x1p{}f;\n", exponent as i32 - 127)
    }
}

/// Returns the WGSL of constants: `NAME` declares the Rust constant of this name, `NAME = value` another value.
macro_rules! gpu_constants {
    (@one $name:ident) => { $crate::gpu_struct::Constant::declared($name, stringify!($name)) };
    (@one $name:ident $value:expr) => { $crate::gpu_struct::Constant::declared($value, stringify!($name)) };
    ($($name:ident $(= $value:expr)?),+ $(,)?) => {
        [$($crate::gpu_struct::gpu_constants!(@one $name $($value)?)),+].concat()
    };
}
pub(crate) use gpu_constants;

/// A struct with the same memory layout in Rust and WGSL, see `gpu_struct!`.
pub trait GpuStruct: Pod {
    /// The name in Rust and WGSL.
    const NAME: &'static str;

    /// Returns the fields in WGSL. Those of a nested struct are inlined.
    fn fields() -> String;

    /// Returns the names of the fields.
    fn names() -> &'static [&'static str];

    /// Returns the declaration in WGSL: `struct Name { … }`.
    fn wgsl() -> String {
        format!("struct {} {{\n{}}}\n", Self::NAME, Self::fields())
    }

    /// Returns the WGSL expression of this value. All fields must be integers.
    fn value(&self) -> String {
        let words: Vec<String> = bytemuck::cast_slice(&[*self]).iter().map(|word: &u32| format!("{word}u")).collect();
        format!("{}({})", Self::NAME, words.join(", "))
    }

    /// Returns a WGSL expression that copies the fields from another struct.
    fn copied_from(other: &str) -> String {
        let fields: Vec<String> = Self::names().iter().map(|name| format!("{other}.{name}")).collect();
        format!("{}({})", Self::NAME, fields.join(", "))
    }
}

/// Declares structs that a shader shares with the host. The `#[repr(C)]` type and the WGSL text are made from the same
/// list of fields. `pub struct A as B` also declares `B`, with every `f32` field copied to all lanes.
///
/// All fields consist of 32-bit words, so neither side adds padding.
macro_rules! gpu_struct {
    () => {};
    ($(#[$about:meta])* pub struct $name:ident as $lanes:ident { $($fields:tt)+ } $($more:tt)*) => {
        $crate::gpu_struct::gpu_struct! { @struct $(#[$about])* $name { $($fields)+ } }
        $crate::gpu_struct::gpu_struct! { @lanes $name $lanes { $($fields)+ } }
        $crate::gpu_struct::gpu_struct! { $($more)* }
    };
    ($(#[$about:meta])* pub struct $name:ident { $($fields:tt)+ } $($more:tt)*) => {
        $crate::gpu_struct::gpu_struct! { @struct $(#[$about])* $name { $($fields)+ } }
        $crate::gpu_struct::gpu_struct! { $($more)* }
    };
    (@struct $(#[$about:meta])* $name:ident { $($(#[$doc:meta])* pub $field:ident: $type:ty,)+ }) => {
        $(#[$about])*
        #[derive(Clone, Copy, Debug, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        pub struct $name { $($(#[$doc])* pub $field: $type,)+ }

        const _: () = assert!(align_of::<$name>() == 4);

        impl $crate::gpu_struct::GpuStruct for $name {
            const NAME: &'static str = stringify!($name);

            fn fields() -> String {
                [$(<$type as $crate::gpu_struct::Field>::declared(stringify!($field))),+].concat()
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
            $($(#[$doc])* pub $field: <$type as $crate::gpu_struct::Field>::Lanes<S>,)+
        }

        impl $crate::gpu_struct::Field for $name {
            type Lanes<S: fearless_simd::Simd> = $lanes<S>;

            fn lanes<S: fearless_simd::Simd>(self, simd: S) -> $lanes<S> {
                $lanes { $($field: $crate::gpu_struct::Field::lanes(self.$field, simd),)+ }
            }

            fn declared(_: &str) -> String {
                <$name as $crate::gpu_struct::GpuStruct>::fields()
            }
        }
    };
}
pub(crate) use gpu_struct;

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;

    gpu_struct! {
        /// For a test.
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
