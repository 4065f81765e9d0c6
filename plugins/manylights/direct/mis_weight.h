#pragma once

/// Multiple importance sampling by the balance heuristic.

#include <drjit/array.h>

namespace manylights {

namespace dr = drjit;

/// weight_a of the balance heuristic, 0 where neither strategy can produce the sample
template <typename Float> Float mis_weight(const Float &pdf_a, const Float &pdf_b) {
    Float w = pdf_a / (pdf_a + pdf_b);
    return dr::select(dr::isfinite(w), w, 0.f);
}

} // namespace manylights
