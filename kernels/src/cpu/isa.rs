//! Instruction sets that the kernels are compiled for, and which of them this machine has.
use std::fmt;

/// An instruction set, best first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Isa {
    /// AVX-512 BF16, and products of tiles of bfloat16 pairs: AMX TILE and BF16 (Linux).
    AmxBf16,
    /// AVX-512, and dot products of pairs of bfloat16 values: AVX-512 BF16.
    Avx512Bf16,
    /// 512-bit vectors: AVX-512 F, VL, DQ and BW.
    Avx512,
    /// 256-bit vectors: AVX2 and FMA.
    Avx2,
    /// Plain Rust over short arrays, for any target.
    Portable,
}

impl Isa {
    const ALL: [Isa; 5] = [Isa::AmxBf16, Isa::Avx512Bf16, Isa::Avx512, Isa::Avx2, Isa::Portable];

    /// The best instruction set of this machine.
    pub fn detect() -> Isa {
        // `Portable` is always supported, so there is a first one.
        Isa::ALL.into_iter().find(|isa| isa.supported()).unwrap_or(Isa::Portable)
    }

    /// All instruction sets of this machine, best first.
    pub fn available() -> Vec<Isa> {
        Isa::ALL.into_iter().filter(|isa| isa.supported()).collect()
    }

    /// Whether it has instructions for products of bfloat16 values; elsewhere they are computed in single precision.
    pub fn multiplies_pairs(self) -> bool {
        matches!(self, Isa::AmxBf16 | Isa::Avx512Bf16)
    }

    /// Whether this machine can run kernels compiled for this instruction set. The first call asks the operating
    /// system for tiles where the CPU has them, for the whole process.
    pub fn supported(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Isa::AmxBf16 => Isa::Avx512Bf16.supported() && super::amx::allowed(),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512Bf16 => Isa::Avx512.supported() && is_x86_feature_detected!("avx512bf16"),
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => {
                Isa::Avx2.supported()
                    && is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512dq")
                    && is_x86_feature_detected!("avx512bw")
            }
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(not(target_arch = "x86_64"))]
            Isa::AmxBf16 | Isa::Avx512Bf16 | Isa::Avx512 | Isa::Avx2 => false,
            Isa::Portable => true,
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Isa::AmxBf16 => "amx_bf16",
            Isa::Avx512Bf16 => "avx512_bf16",
            Isa::Avx512 => "avx512",
            Isa::Avx2 => "avx2",
            Isa::Portable => "portable",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn detected_set_is_the_first_available() {
        let available = Isa::available();
        assert_eq!(available.first(), Some(&Isa::detect()));
        assert_eq!(available.last(), Some(&Isa::Portable));
    }
}
