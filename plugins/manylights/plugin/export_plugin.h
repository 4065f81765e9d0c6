#pragma once

/**
 * Registration of a plugin that is compiled for some of Mitsuba's variants only.
 *
 * Mitsuba's MI_EXPORT_PLUGIN instantiates a plugin for all variants in one translation
 * unit, which takes minutes and gigabytes. Here the build compiles one translation unit for
 * every chosen variant, with MANYLIGHTS_VARIANT set to the name of the variant. It includes
 * the source files of all plugins, since most of their templates are the same, with
 * MANYLIGHTS_PLUGIN set to the name of each. The plugins add themselves to a list when
 * libmanylights is loaded, which has all of them; init_plugin.cpp hands the list to Mitsuba.
 */

#include <mitsuba/core/object.h>
#include <mitsuba/core/properties.h>
#include <mitsuba/core/spectrum.h>
#include <mitsuba/mitsuba.h>
#include <vector>

namespace manylights {

/// The types that one of Mitsuba's variants stands for
template <typename Float_, typename Spectrum_> struct Variant {
    using Float                       = Float_;
    using Spectrum                    = Spectrum_;
    static constexpr const char *name = mitsuba::detail::variant<Float, Spectrum>::name;
};

/// All variants of the wheel, under the names that users give them
namespace variants {

template <typename Float, size_t Size> using Color = mitsuba::Color<Float, Size>;
template <typename Float> using Spectral           = mitsuba::Spectrum<Float, 4>;
template <typename Spectrum> using Mueller         = mitsuba::MuellerMatrix<Spectrum>;

using LLVM = drjit::DiffArray<JitBackend::LLVM, float>;
using CUDA = drjit::DiffArray<JitBackend::CUDA, float>;

using scalar_rgb                 = Variant<float, Color<float, 3>>;
using scalar_spectral            = Variant<float, Spectral<float>>;
using scalar_spectral_polarized  = Variant<float, Mueller<Spectral<float>>>;
using llvm_ad_rgb                = Variant<LLVM, Color<LLVM, 3>>;
using llvm_ad_mono               = Variant<LLVM, Color<LLVM, 1>>;
using llvm_ad_mono_polarized     = Variant<LLVM, Mueller<Color<LLVM, 1>>>;
using llvm_ad_spectral           = Variant<LLVM, Spectral<LLVM>>;
using llvm_ad_spectral_polarized = Variant<LLVM, Mueller<Spectral<LLVM>>>;
using cuda_ad_rgb                = Variant<CUDA, Color<CUDA, 3>>;
using cuda_ad_mono               = Variant<CUDA, Color<CUDA, 1>>;
using cuda_ad_mono_polarized     = Variant<CUDA, Mueller<Color<CUDA, 1>>>;
using cuda_ad_spectral           = Variant<CUDA, Spectral<CUDA>>;
using cuda_ad_spectral_polarized = Variant<CUDA, Mueller<Spectral<CUDA>>>;

} // namespace variants

/// What Mitsuba has to know about a plugin in one variant
struct CompiledVariant {
    std::string_view plugin;
    std::string_view variant;
    mitsuba::ObjectType type;
    mitsuba::PluginInstantiateFn instantiate;
};

/// All plugins in all variants, in no particular order; filled while the library is loaded
std::vector<CompiledVariant> &compiled_variants();

/// Adds the class Plugin, an instance of a plugin's template, to the list
template <typename Plugin, typename Variant>
bool add_compiled_variant(std::string_view plugin) {
    auto instantiate = [](void *, const mitsuba::Properties &props) {
        return mitsuba::ref<mitsuba::Object>(new Plugin(props));
    };
    compiled_variants().push_back({ plugin, Variant::name, Plugin::Type, instantiate });
    return true;
}

} // namespace manylights

/// Ends the source file of a plugin; Name is its class template
#define MANYLIGHTS_EXPORT_PLUGIN(Name)                                                   \
    [[maybe_unused]] static const bool Name##_registered =                               \
        ::manylights::add_compiled_variant<                                              \
            Name<::manylights::variants::MANYLIGHTS_VARIANT::Float,                      \
                 ::manylights::variants::MANYLIGHTS_VARIANT::Spectrum>,                  \
            ::manylights::variants::MANYLIGHTS_VARIANT>(MANYLIGHTS_PLUGIN);
