//! Inner loops compiled for the vector instructions that the processor has.

/// Something to be run by [`vectorised`]; `run`, and all that it calls in its loops, is to be inlined.
pub trait Work {
    type Output;

    fn run(self) -> Self::Output;
}

/// Runs `work` compiled for AVX-512 or AVX2 where the processor has it. Nothing is contracted or reordered, so the result is the same to the
/// bit.
#[inline(always)]
pub fn vectorised<R>(work: impl Work<Output = R>) -> R {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
        fn widest<R>(work: impl Work<Output = R>) -> R {
            work.run()
        }
        #[target_feature(enable = "avx2")]
        fn wide<R>(work: impl Work<Output = R>) -> R {
            work.run()
        }
        let has_all = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512bw")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512vl");
        if has_all {
            // SAFETY: the processor has what the function was compiled for.
            return unsafe { widest(work) };
        }
        if is_x86_feature_detected!("avx2") {
            // SAFETY: as above.
            return unsafe { wide(work) };
        }
    }
    work.run()
}
