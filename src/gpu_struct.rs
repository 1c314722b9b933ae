//! Structs and constants that the host shares with its shaders.

use bytemuck::Pod;
use fearless_simd::{Simd, prelude::*};

/// The type of a field of a GPU struct: 32 bits, another GPU struct, or an array of either.
pub trait Field: Pod {
    /// The type with one team per lane: `f32` is copied to all lanes, other fields keep their type.
    type Lanes<S: Simd>: Copy;

    /// Converts a value to [`Field::Lanes`].
    fn lanes<S: Simd>(self, simd: S) -> Self::Lanes<S>;

    /// Returns the WGSL lines that declare a field of this type.
    fn declared(name: &str) -> String;

    /// Returns the WGSL expressions of the value, separated by commas.
    fn value(&self) -> String;

    /// Returns the names in WGSL of a field of this type.
    fn names(name: &'static str) -> Vec<&'static str> {
        vec![name]
    }
}

impl Field for u32 {
    type Lanes<S: Simd> = u32;

    fn lanes<S: Simd>(self, _: S) -> u32 {
        self
    }

    fn declared(name: &str) -> String {
        format!("    {name}: u32,\n")
    }

    fn value(&self) -> String {
        format!("{self}u")
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

    fn value(&self) -> String {
        format!("bitcast<f32>({}u)", self.to_bits())
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

            fn value(&self) -> String {
                let items: Vec<String> = self.iter().map(Field::value).collect();
                format!("array<{}, {N}>({})", stringify!($of), items.join(", "))
            }
        }
    )*};
}
lists!(u32 f32);

impl<T: GpuStruct + Field, const N: usize> Field for [T; N]
where
    [T; N]: Pod,
{
    type Lanes<S: Simd> = [T::Lanes<S>; N];

    fn lanes<S: Simd>(self, simd: S) -> [T::Lanes<S>; N] {
        self.map(|item| item.lanes(simd))
    }

    fn declared(name: &str) -> String {
        format!("    {name}: array<{}, {N}>,\n", T::NAME)
    }

    fn value(&self) -> String {
        let items: Vec<String> = self.iter().map(GpuStruct::literal).collect();
        format!("array<{}, {N}>({})", T::NAME, items.join(", "))
    }
}

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

    /// Returns the names of the fields. Those of a nested struct are inlined.
    fn names() -> Vec<&'static str>;

    /// Returns the declaration in WGSL: `struct Name { … }`.
    fn wgsl() -> String {
        format!("struct {} {{\n{}}}\n", Self::NAME, Self::fields())
    }

    /// Returns the WGSL expressions of the fields, separated by commas.
    fn values(&self) -> String;

    /// Returns the WGSL expression of this value: `Name(…)`.
    fn literal(&self) -> String {
        format!("{}({})", Self::NAME, self.values())
    }

    /// Returns a WGSL expression that copies the fields from another struct.
    fn copied_from(other: &str) -> String {
        let fields: Vec<String> = Self::names().iter().map(|name| format!("{other}.{name}")).collect();
        format!("{}({})", Self::NAME, fields.join(", "))
    }
}

/// Declares structs that a shader shares with the host. The `#[repr(C)]` type and the WGSL text are made from the same
/// list of fields. `pub struct A as B` also declares `B`, with every `f32` field copied to all lanes; `as itself` is for
/// structs of integers.
///
/// All fields consist of 32-bit words, so neither side adds padding.
macro_rules! gpu_struct {
    () => {};
    ($(#[$about:meta])* pub struct $name:ident as itself { $($fields:tt)+ } $($more:tt)*) => {
        $crate::gpu_struct::gpu_struct! { @struct $(#[$about])* $name { $($fields)+ } }
        impl $crate::gpu_struct::Field for $name {
            type Lanes<S: fearless_simd::Simd> = $name;

            fn lanes<S: fearless_simd::Simd>(self, _: S) -> $name {
                self
            }

            $crate::gpu_struct::gpu_struct! { @nested }
        }
        $crate::gpu_struct::gpu_struct! { $($more)* }
    };
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

            fn names() -> Vec<&'static str> {
                [$(<$type as $crate::gpu_struct::Field>::names(stringify!($field))),+].concat()
            }

            fn values(&self) -> String {
                [$($crate::gpu_struct::Field::value(&self.$field)),+].join(", ")
            }
        }
    };
    (@nested) => {
        fn declared(_: &str) -> String {
            <Self as $crate::gpu_struct::GpuStruct>::fields()
        }

        fn value(&self) -> String {
            $crate::gpu_struct::GpuStruct::values(self)
        }

        fn names(_: &'static str) -> Vec<&'static str> {
            <Self as $crate::gpu_struct::GpuStruct>::names()
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

            $crate::gpu_struct::gpu_struct! { @nested }
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
        assert_eq!(Duo { size: 7, count: 8 }.literal(), "Duo(7u, 8u)");
        assert_eq!(Duo::copied_from("world"), "Duo(world.size, world.count)");
        assert_eq!(
            Outer::copied_from("a"),
            "Outer(a.first, a.size, a.count, a.list, a.numbers)",
            "fields of a nested struct are inlined"
        );
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
