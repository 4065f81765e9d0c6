/**
 * The entry point that Mitsuba looks for in each plugin; see export_plugin.h.
 *
 * It refuses to work with a Mitsuba of another ABI, since the alternative is a crash, and
 * it answers for the variants that were not compiled with a message that says how to get
 * them. Mitsuba shows the text of what is thrown here to the user.
 */

#include "export_plugin.h"
#include <drjit/packet.h>
#include <mitsuba/core/util.h>
#include <stdexcept>
#include <string>

namespace manylights {

using mitsuba::Object, mitsuba::PluginRegisterFn, mitsuba::Properties, mitsuba::ref;

std::vector<CompiledVariant> &compiled_variants() {
    // Inside a function, because it is filled by initializers of other files.
    static std::vector<CompiledVariant> list;
    return list;
}

namespace {

/// Throws if the running Mitsuba is not the one that this file was compiled for
void check_abi(const std::string &plugin) {
    const std::string running = mitsuba::util::info_build(/* thread_count = */ 1);
    const std::string lanes   = std::to_string(drjit::Packet<float>::Size);

    auto require = [&](const std::string &text, const std::string &compiled_for,
                       const std::string &command) {
        if (running.find(text) == std::string::npos)
            throw std::runtime_error(
                "The plugin \"" + plugin + "\" was compiled for " + compiled_for +
                " and cannot run in this one: " + running + ". Type\n  " + command);
    };

    // Enclosed in separators, so that 3.9.1 is not found in 3.9.10, nor 8 lanes in 18.
    require("version " MI_VERSION " ", "Mitsuba " MI_VERSION,
            "pip install \"mitsuba==" MI_VERSION "\"");
    require(", " + lanes + "-wide SIMD",
            "the Mitsuba wheel, with " + lanes + "-wide SIMD,",
            "pip install --force-reinstall --no-deps \"mitsuba==" MI_VERSION "\"");
}

/// One plugin in the variants that were compiled
std::vector<CompiledVariant> compiled_variants_of(std::string_view plugin) {
    std::vector<CompiledVariant> result;
    for (const CompiledVariant &compiled : compiled_variants())
        if (compiled.plugin == plugin)
            result.push_back(compiled);
    return result;
}

/// Stands in for the instantiation of a plugin in a variant that was not compiled
template <typename Variant> ref<Object> refuse(void *, const Properties &props) {
    std::string available;
    for (const CompiledVariant &compiled : compiled_variants_of(props.plugin_name()))
        available += (available.empty() ? "" : ",") + std::string(compiled.variant);
    throw std::runtime_error(
        "The plugin \"" + std::string(props.plugin_name()) +
        "\" was compiled for the variants " + available + " and not for " +
        Variant::name + ". To add it, type in the source folder of manylights\n" +
        "  MANYLIGHTS_VARIANTS=" + available + "," + Variant::name + " pip install .");
}

template <typename Variant>
void register_variant(const std::vector<CompiledVariant> &compiled_variants,
                      PluginRegisterFn register_plugin) {
    // A plugin has one type in all variants. Mitsuba asks for it before it knows which
    // variant to use.
    CompiledVariant entry = compiled_variants.front();
    entry.variant         = Variant::name;
    entry.instantiate     = refuse<Variant>;
    for (const CompiledVariant &compiled : compiled_variants)
        if (compiled.variant == entry.variant)
            entry = compiled;
    register_plugin(entry.plugin, entry.variant, entry.type, entry.instantiate);
}

template <typename... Variants>
void register_variants(std::string_view plugin, PluginRegisterFn register_plugin) {
    const std::vector<CompiledVariant> compiled = compiled_variants_of(plugin);
    if (compiled.empty())
        throw std::runtime_error("manylights has no plugin \"" + std::string(plugin) +
                                 "\".");
    (register_variant<Variants>(compiled, register_plugin), ...);
}

} // namespace
} // namespace manylights

extern "C" MI_EXPORT void init_plugin(std::string_view plugin,
                                      mitsuba::PluginRegisterFn register_plugin) {
    using namespace manylights;
    using namespace manylights::variants;
    check_abi(std::string(plugin));
    register_variants<scalar_rgb, scalar_spectral, scalar_spectral_polarized, llvm_ad_rgb,
                      llvm_ad_mono, llvm_ad_mono_polarized, llvm_ad_spectral,
                      llvm_ad_spectral_polarized, cuda_ad_rgb, cuda_ad_mono,
                      cuda_ad_mono_polarized, cuda_ad_spectral,
                      cuda_ad_spectral_polarized>(plugin, register_plugin);
}
