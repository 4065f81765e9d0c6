/**
 * The file that Mitsuba opens for each plugin. It is empty but for a reference to libmanylights
 * beside it, which has all plugins and the function init_plugin that Mitsuba looks for.
 */

extern "C" void init_plugin();

/// Without it, linkers may drop the library
extern "C" __attribute__((visibility("default"))) void (*const manylights_library)();
void (*const manylights_library)() = init_plugin;
