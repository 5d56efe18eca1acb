//! Inner loops compiled for several sets of vector instructions, chosen at run time.

/// An inner loop for [`vectorised`]. Mark `run`, and every function that it calls in its loops,
/// `#[inline(always)]`: only inlined code is compiled for the vector instructions.
pub trait Kernel {
    type Output;

    fn run(self) -> Self::Output;
}

/// Runs `work`, compiled for AVX-512 or AVX2 if the processor has it. No operation is fused or
/// reordered, so every variant gives the same bits.
#[inline(always)]
pub fn vectorised<R>(work: impl Kernel<Output = R>) -> R {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
        fn widest<R>(work: impl Kernel<Output = R>) -> R {
            work.run()
        }
        #[target_feature(enable = "avx2")]
        fn wide<R>(work: impl Kernel<Output = R>) -> R {
            work.run()
        }
        let has_all = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        if has_all {
            // SAFETY: the processor has all features that the function is compiled for, as was just
            // checked.
            return unsafe { widest(work) };
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: the processor has AVX2, as was just checked.
            return unsafe { wide(work) };
        }
    }
    work.run()
}
