//! Random numbers of the host by counter (Philox 4x32-10, Salmon et al. 2011): draw `i` of a stream is a function of
//! (seed, stream, i) alone, the same on every machine and in whatever order streams are used.

/// One stream of random numbers.
#[derive(Clone, Debug)]
pub struct Random {
    key: [u32; 2],
    counter: u64,
    block: [u32; 4],
    /// Words of `block` not given out yet.
    left: usize,
}

impl Random {
    /// The stream called `stream` of a seed.
    pub fn new(seed: u32, stream: &str) -> Random {
        // FNV-1a: names need only be told apart.
        let hash = stream.bytes().fold(0x811c_9dc5u32, |h, b| (h ^ u32::from(b)).wrapping_mul(0x0100_0193));
        Random { key: [seed, hash], counter: 0, block: [0; 4], left: 0 }
    }

    pub fn next_u32(&mut self) -> u32 {
        if self.left == 0 {
            self.block = philox([self.counter as u32, (self.counter >> 32) as u32, 0, 0], self.key);
            self.counter += 1;
            self.left = 4;
        }
        self.left -= 1;
        self.block[3 - self.left]
    }

    /// Uniform in (0, 1), never either end.
    pub fn uniform(&mut self) -> f64 {
        let bits = u64::from(self.next_u32()) << 20 | u64::from(self.next_u32() >> 12);
        (bits as f64 + 0.5) / (1u64 << 52) as f64
    }

    /// Standard normal (Box-Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * self.uniform().ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// `n` normal numbers of standard deviation `deviation`.
    pub fn normals<const N: usize>(&mut self, deviation: f64) -> [f64; N] {
        std::array::from_fn(|_| deviation * self.normal())
    }
}

/// Ten rounds of Philox 4x32.
fn philox(mut c: [u32; 4], mut k: [u32; 2]) -> [u32; 4] {
    for _ in 0..10 {
        let (a, b) = (u64::from(c[0]) * 0xd251_1f53, u64::from(c[2]) * 0xcd9e_8d57);
        c = [(b >> 32) as u32 ^ c[1] ^ k[0], b as u32, (a >> 32) as u32 ^ c[3] ^ k[1], a as u32];
        k = [k[0].wrapping_add(0x9e37_79b9), k[1].wrapping_add(0xbb67_ae85)];
    }
    c
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The known answers published with the generator.
    #[test]
    fn philox_known_answers() {
        assert_eq!(philox([0; 4], [0; 2]), [0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8]);
        assert_eq!(philox([u32::MAX; 4], [u32::MAX; 2]), [0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd]);
    }

    #[test]
    fn normals_have_unit_variance() {
        let mut r = Random::new(7, "test");
        let x: Vec<f64> = (0..20000).map(|_| r.normal()).collect();
        let mean = x.iter().sum::<f64>() / x.len() as f64;
        let variance = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / x.len() as f64;
        assert!(mean.abs() < 0.03 && (variance - 1.0).abs() < 0.05, "mean {mean}, variance {variance}");
    }
}
