#pragma once

#include "manylights/base/recording.h"
#include <mitsuba/core/spectrum.h>

namespace manylights {

/// Tables of Mitsuba that kernels of spectral variants read: it does not show them to dr.freeze
template <typename Float, typename Spectrum> struct ColorTables {
    void traverse_1_cb_ro(void *payload, dr::detail::traverse_callback_ro fn) const {
        visit([&](auto &table) { dr::traverse_1_fn_ro(table, payload, fn); });
    }
    void traverse_1_cb_rw(void *payload, dr::detail::traverse_callback_rw fn) {
        visit([&](auto &table) { dr::traverse_1_fn_rw(table, payload, fn); });
    }

private:
    /// Copies, that others cannot be assigned to
    template <typename Visitor> static void visit(const Visitor &visitor) {
        if constexpr (dr::is_jit_v<Float> && mitsuba::is_spectral_v<Spectrum>) {
            auto tables =
                mitsuba::detail::get_color_space_tables<dr::float32_array_t<Float>>();
            visitor(tables.xyz);
            visitor(tables.srgb);
            visitor(tables.d65);
        }
    }
};

} // namespace manylights
